"""Reports on finished runs: tables, figures and a verdict on every claim."""
