"""The report on finished runs: tables, figures and a verdict on every claim, from results folders alone."""
