"""Tokenizers: frames to discrete ids and back, behind one interface (`base.Tokenizer`)."""
