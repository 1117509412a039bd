"""Recipes, one TOML file per environment family, installed as the package `tcmrl_manifests`."""
