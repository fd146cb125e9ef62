"""What AST is compared with: models of other papers behind the same interface."""
