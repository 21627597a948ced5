"""Tokenizers: frames to discrete ids or latent vectors and back, behind one interface
(`base.Tokenizer`).

Trained here: `lfq` and `continuous`, with the network in `network`. Trained by others: `pretrained`, with the networks
in `magvit2` and `svd_vae`. From the user's own code: `python`. Without a network: `pixels`. `io` has the table of all
kinds.
"""
