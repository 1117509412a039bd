"""Datasets in the formats of other libraries.

`formats` holds the plug-ins of `tcmrl-data export`; a file of `views` turns a selection of a dataset into
another library's object in memory. Libraries are imported inside functions, so that listing formats stays
cheap.
"""
