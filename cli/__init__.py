"""The commands `tcmrl-data` and `tcmrl`: parse, call one function, print."""
