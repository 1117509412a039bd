"""The commands `tcmrl-data` and `tcmrl`: they parse arguments, call the library and print the result."""
