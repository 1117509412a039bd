"""The methods: one a file, TCMRL's other readings in a second one, and what methods share in `core`."""
