"""Tables of results that are reproduced from their recipes: measured, stored as JSON, and written into their pages.

`recipe` defines a table of scores, which `measure` simulates, traces and scores (`scores`) and `make` puts together;
`commands` makes tables of what other commands measure. `finished` stores what was measured, `provenance` records the code that a table
was made with, `status` says whether it has changed since, `table` writes the JSON and `markdown` the pages.
"""
