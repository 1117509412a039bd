"""The frame of HTML pages in one file, as Jinja templates; it knows no dataset."""
