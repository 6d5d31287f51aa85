"""What a new user does first: shells to type into, and what goes wrong in them."""
