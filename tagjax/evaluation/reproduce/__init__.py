"""Tables of results that are made again from their recipes: measured, kept as JSON, and written into their pages.

`recipe` says what a table holds, `measure` simulates, traces and scores, `interval` gives confidence intervals,
`provenance` says which code a table was made with and whether that has changed since, `table` writes the JSON and
`markdown` the pages.
"""
