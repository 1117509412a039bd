"""A dataset's report: a page that shows what is in it."""
