"""Motor controllers byte for byte, one file each, with the weaknesses that the real ones have."""
