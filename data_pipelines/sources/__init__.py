"""Where robot data comes from: episodes of other people's formats, read where they lie."""
