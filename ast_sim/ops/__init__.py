"""The ops of ast_sim: torch custom ops over the C core, each beside its torch composition."""
