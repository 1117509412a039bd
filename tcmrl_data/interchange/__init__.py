"""What other libraries read, one format or library a file.

A format has NAME and `export(dataset, out, *, snapshots, progress)`, which writes a selection of a
dataset's snapshots (a rule of `Dataset.select`) into the new folder `out`, calls `progress(parts done,
parts in all)` as it goes, and returns the files it wrote. Files without NAME turn a selection into
another library's object in memory. Libraries are imported inside functions, so that listing formats stays
cheap.
"""
