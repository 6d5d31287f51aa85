"""What takes long and breaks things: one case a module, whose one function takes how much of it is wanted."""
