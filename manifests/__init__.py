"""Recipes, one TOML file per environment family; installed as the data package `tcmrl_manifests`."""
