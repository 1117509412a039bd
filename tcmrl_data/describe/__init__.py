"""What a dataset says of itself: card, citation, Croissant, schemas, films of episodes, an HTML report."""
