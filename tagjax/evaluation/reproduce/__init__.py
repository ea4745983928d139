"""Tables of results that are reproduced from their recipes: measured, stored as JSON, and written into their pages.

`recipe` defines a table, `measure` simulates, traces and scores, `interval` computes confidence intervals, `provenance`
records the code that a table was made with and detects changes, `table` writes the JSON and `markdown` the pages.
"""
