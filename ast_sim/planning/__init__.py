"""What a training will give, from short trials of it, and when a model pays."""
