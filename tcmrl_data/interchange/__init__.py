"""Interchange formats, one a file: each has NAME and `export(dataset, out, *, snapshots, progress)`.

`export` writes a selection of a dataset's snapshots (a rule of `Dataset.select`) into the new folder
`out`, calls `progress(parts done, parts in all)` as it goes, and returns the files it wrote. Libraries of
a format are imported inside its functions, so that listing formats stays cheap.
"""
