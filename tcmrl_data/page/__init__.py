"""HTML pages in one file: escaped markup, figures, and the frame around them. Knows no dataset."""
