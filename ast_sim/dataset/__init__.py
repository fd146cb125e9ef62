"""The dataset file: its layout, reading it, writing it, describing it."""
