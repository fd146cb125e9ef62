"""Export, reports and pictures. Nothing here imports torch."""
