"""The compiled step of DISCO; docs/kernel.md draws how its buffers are laid out."""
