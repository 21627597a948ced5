"""A process that runs stages of the official PyTorch release on request, as `stages` runs ours.

It is started in an environment of its own, which has torch and what the release imports, with a checkout of the release
(github.com/liruiw/HMA) on its path; nothing of the release is part of this project. Its arguments are the number of
examples at a time and the number format. On CPU the release's `.cuda()` must do nothing, and its attention is the one
that it uses without xformers. On a GPU it computes as its training program does: float32 products at "medium"
precision, attention by a fused kernel, which is torch's own if xformers is not installed.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import sys
import time
import types

FRAME, PROMPT, WINDOW = 256, 6, 12
ROBOT, ACTION_WIDTH = "robot", 21


def prepare() -> str:
    """Tells the release what it needs to know of this machine; returns the device."""
    import torch

    torch.manual_seed(0)
    if torch.cuda.is_available():
        torch.set_default_device("cuda")
        torch.set_float32_matmul_precision("medium")
        if importlib.util.find_spec("xformers") is None:
            stand_in(memory_efficient_attention=attend, LowerTriangularMask=bool, unbind=torch.unbind)
        return "cuda"
    os.environ["XFORMERS_DISABLED"] = "true"
    stand_in(memory_efficient_attention=None, LowerTriangularMask=None, unbind=None)
    torch.Tensor.cuda = lambda self, *args, **options: self
    return "cpu"


def stand_in(**names) -> None:
    """`names` in the place of xformers.ops."""
    xformers, ops = types.ModuleType("xformers"), types.ModuleType("xformers.ops")
    vars(ops).update(names)
    xformers.ops = ops
    sys.modules.update({"xformers": xformers, "xformers.ops": ops})


def attend(q, k, v, attn_bias=None, scale=None):
    """Attention for q, k, v [B, N, H, D]; causal if `attn_bias` is given, since the release gives no other bias."""
    from torch.nn.functional import scaled_dot_product_attention

    turned = (x.transpose(1, 2) for x in (q, k, v))
    return scaled_dot_product_attention(*turned, is_causal=attn_bias is not None, scale=scale).transpose(1, 2)


class ReleasedModels:
    """The released base models with random weights, `rows` windows of one robot, computed in `dtype`."""

    def __init__(self, rows: int, dtype: str):
        self.device = prepare()
        import torch

        self.torch, self.rows, self.dtype = torch, rows, dtype
        self.ids = torch.randint(0, 2**18, (rows, WINDOW, 16, 16))
        self.latents = torch.randn(rows, WINDOW, 32, 32, 4)
        self.actions = torch.randn(rows, WINDOW, ACTION_WIDTH)
        self.robots = [ROBOT] * rows
        self.models: dict[str, object] = {}

    def computing(self):
        """A context in which the release computes: float32, or automatic mixed precision."""
        if self.dtype == "float32":
            return contextlib.nullcontext()
        return self.torch.autocast(self.device, getattr(self.torch, self.dtype))

    def finish(self) -> None:
        if self.device == "cuda":
            self.torch.cuda.synchronize()

    def discrete(self):
        if "discrete" not in self.models:
            from hma.config import GenieConfig
            from hma.model.st_mask_git import STMaskGIT

            settings = dict(T=WINDOW, S=FRAME, image_vocab_size=2**18, num_factored_vocabs=2, use_mup=False)
            model = self._with_robot(STMaskGIT(GenieConfig(**self._sizes(), **settings, proj_bias=True, mlp_bias=True)))
            model.h = model.w = 16
            self.models["discrete"] = model
            self.optimizer = self.torch.optim.AdamW(model.parameters(), lr=1e-4)
        return self.models["discrete"]

    def continuous(self):
        if "continuous" not in self.models:
            from hma.config import DiffusionGenieConfig
            from hma.model.st_mar import STMAR

            settings = dict(T=WINDOW, S=4 * FRAME, image_vocab_size=None, patch_size=2)
            self.models["continuous"] = self._with_robot(STMAR(DiffusionGenieConfig(**self._sizes(), **settings)))
        return self.models["continuous"]

    def _sizes(self) -> dict:
        return dict(
            num_layers=32, num_heads=8, d_model=256, action_network="concat+modulate", qkv_bias=False,
            attn_drop=0.0, qk_norm=False,
        )  # fmt: skip

    def _with_robot(self, model):
        statistics = [[[0.0] * 7, [1.0] * 7]]
        model.init_action_projectors([ROBOT], [ACTION_WIDTH], statistics, "concat+modulate")
        return model.to(self.device)

    def forward(self) -> None:
        model = self.discrete().eval()
        with self.torch.no_grad():
            model.compute_logits(self.ids, action_ids=self.actions, domain=self.robots)

    def frame(self) -> None:
        """Two passes over one frame, each over the whole window: the release has no other way."""
        model = self.discrete().eval()
        self._generate(model, self.ids.clone(), model.mask_token_id)

    def continuous_frame(self) -> None:
        model = self.continuous().eval()
        self._generate(model, self.latents.clone(), model.mask_token.view(-1))

    def _generate(self, model, window, mask) -> None:
        with self.torch.no_grad():
            window[:, PROMPT:] = mask
            model.maskgit_generate(
                window, out_t=PROMPT, maskgit_steps=2, temperature=0.0, action_ids=self.actions, domain=self.robots
            )

    def step(self) -> None:
        model = self.discrete().train()
        labels = self.ids.reshape(self.rows, -1)
        inputs = labels.clone()
        inputs[self.torch.rand(inputs.shape) < 0.5] = model.mask_token_id
        inputs[:, :FRAME] = labels[:, :FRAME]
        side = self.torch.tensor([16] * self.rows)
        loss = model(input_ids=inputs, labels=labels, action_ids=self.actions, domain=self.robots, h=side, w=side).loss
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    rows, dtype = sys.argv[1:]
    released = ReleasedModels(int(rows), dtype)
    calls = {
        "forward": released.forward,
        "frame": released.frame,
        "step": released.step,
        "continuous frame": released.continuous_frame,
    }
    for line in sys.stdin:
        began = time.perf_counter()
        with released.computing():
            calls[line.strip()]()
        released.finish()
        print(time.perf_counter() - began, file=answers, flush=True)


if __name__ == "__main__":
    main()
