"""What a dataset says of itself to people and programs: card, citation, Croissant, JSON Schemas."""
