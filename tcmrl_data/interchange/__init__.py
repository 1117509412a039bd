"""Datasets in the formats of other libraries, one file a format: writing and reading stand beside each other.

`exporting` has the base class of formats and `export_dataset`, `reader` the base class of readers,
`importing` has `import_dataset`. `recorder` records a Gymnasium environment. `sb3`, `tensordict` and
`torch_dataset` turn a selection of a dataset into another library's object in memory.
"""
