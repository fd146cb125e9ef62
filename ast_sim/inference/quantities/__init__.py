"""What is known of an answer: its forces and figures, its errors, how far it may be from the truth."""
