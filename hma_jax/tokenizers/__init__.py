"""Tokenizers: frames to discrete ids or latent vectors and back, behind one interface
(`base.Tokenizer`)."""
