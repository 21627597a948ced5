"""Tokenizers: frames to discrete ids or latent vectors and back, behind one interface
(`base.Tokenizer`).

Trained here: `lfq` and `continuous`, on the network of `network`. Trained by others: `pretrained`, on
those of `magvit2` and `svd_vae`. Of the user's own code: `python`. Without a network: `pixels`. `io`
keeps one table of all kinds.
"""
