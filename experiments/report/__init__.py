"""What a study leaves behind: figures, tables and the page."""
