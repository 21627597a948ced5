"""HMA in JAX: the model, its training, generation, evaluation and tokenizers.

This package knows no file format of robot data and no experiment. Dimension letters used
throughout, in signatures, parameter axes and tensor names:

    B batch             T frames               S image tokens per frame
    K action tokens     D width                H heads (I = D / H, one head's width)
    N layers            F mlp width            E embodiments
    W width of a diffusion head
    U padded action width (stride x native dim)
    Q vocabulary factors                       V entries per factor
    C latent channels   P tokens per frame in the trunk (S + K)
"""

__version__ = "0.1.0"
