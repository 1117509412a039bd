"""What a method is."""
