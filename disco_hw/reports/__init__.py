"""What every report shares: results as JSON, files that are written, style."""
