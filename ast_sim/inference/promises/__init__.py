"""What is promised of an answer: how far it may be from the truth, an error that it keeps, a time that it takes."""
