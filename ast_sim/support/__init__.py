"""Tools that every other part uses: errors, settings as text, files on the disk, progress, provenance."""
