"""A process that runs stages of the official PyTorch release when told to, as `stages` runs ours.

It is started in an environment of its own, which has torch and what the release imports, with a checkout of
the release (github.com/liruiw/HMA) on its path; nothing of it is part of this project. On CPU the release's
`.cuda()` must mean nothing, and its attention the one it has without xformers.
"""

from __future__ import annotations

import os
import sys
import time
import types

FRAME, PROMPT, WINDOW = 256, 6, 12
ROBOT, ACTION_WIDTH = "robot", 21


def prepare() -> None:
    """What the release needs to be told on a machine without a GPU."""
    import torch

    os.environ["XFORMERS_DISABLED"] = "true"
    xformers, ops = types.ModuleType("xformers"), types.ModuleType("xformers.ops")
    for name in ("LowerTriangularMask", "memory_efficient_attention", "unbind"):
        setattr(ops, name, None)
    xformers.ops = ops
    sys.modules.update({"xformers": xformers, "xformers.ops": ops})
    torch.Tensor.cuda = lambda self, *args, **options: self
    torch.manual_seed(0)


class Released:
    """The released base models with drawn weights, one window of one robot."""

    def __init__(self):
        import torch

        self.torch = torch
        self.ids = torch.randint(0, 2**18, (1, WINDOW, 16, 16))
        self.latents = torch.randn(1, WINDOW, 32, 32, 4)
        self.actions = torch.randn(1, WINDOW, ACTION_WIDTH)
        self.models: dict[str, object] = {}

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
        return model

    def forward(self) -> None:
        model = self.discrete().eval()
        with self.torch.no_grad():
            model.compute_logits(self.ids, action_ids=self.actions, domain=[ROBOT])

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
                window, out_t=PROMPT, maskgit_steps=2, temperature=0.0, action_ids=self.actions, domain=[ROBOT]
            )

    def step(self) -> None:
        model = self.discrete().train()
        labels = self.ids.reshape(1, -1)
        inputs = labels.clone()
        inputs[self.torch.rand(inputs.shape) < 0.5] = model.mask_token_id
        inputs[:, :FRAME] = labels[:, :FRAME]
        side = self.torch.tensor([16])
        loss = model(
            input_ids=inputs, labels=labels, action_ids=self.actions, domain=[ROBOT], h=side, w=side
        ).loss
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    prepare()
    released = Released()
    calls = {
        "forward": released.forward,
        "frame": released.frame,
        "step": released.step,
        "continuous frame": released.continuous_frame,
    }
    for line in sys.stdin:
        began = time.perf_counter()
        calls[line.strip()]()
        print(time.perf_counter() - began, file=answers, flush=True)


if __name__ == "__main__":
    main()
