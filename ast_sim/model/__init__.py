"""AST: the model of the paper, exactly as docs/model.md states it."""
