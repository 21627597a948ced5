"""The metrics of an evaluation: their names, and with what each may be compared. What they mean is in `protocol`,
`images` and `controllability`, and in docs/results.md.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    label: str  # in headings
    unit: str = ""  # shown beside the label or the name; "": none, or it is in the label
    of_tokens: bool = False  # comparable only between models on the same tokens
    of_windows: bool = False  # depends only on the windows, not on the model
    optional: bool = False  # nan for some windows: see OPTIONAL_METRICS
    evaluated: bool = False  # in the table of `hma evaluate`; its files hold all
    compared: bool = False  # in the table of `hma compare`; its file holds all

    @property
    def heading(self) -> str:
        return f"{self.label} ({self.unit})" if self.unit else self.label


METRICS = {
    "cross_entropy": Metric("nats per token", of_tokens=True, compared=True),
    "perplexity": Metric("perplexity", of_tokens=True, evaluated=True),
    "perplexity_corpus": Metric("perplexity of all windows", of_tokens=True),
    "accuracy": Metric("accuracy", of_tokens=True, evaluated=True),
    "diffusion_loss": Metric("diffusion loss", of_tokens=True, evaluated=True, compared=True),
    "psnr": Metric("PSNR", "dB", evaluated=True, compared=True),
    "psnr_last": Metric("PSNR of the last frame", "dB", evaluated=True),
    "psnr_copy": Metric("copying", "dB", of_windows=True, evaluated=True),
    "psnr_random": Metric("PSNR of the last frame, random actions", "dB"),
    "ssim": Metric("SSIM", evaluated=True),
    "lpips": Metric("LPIPS", evaluated=True, compared=True),
    "lpips_copy": Metric("LPIPS of copying", of_windows=True, evaluated=True),
    "delta_psnr": Metric("ΔPSNR", "dB", evaluated=True, compared=True),
    "action_nats": Metric("action-nats", of_tokens=True, optional=True, evaluated=True, compared=True),
    "retrieval": Metric("retrieval", optional=True, evaluated=True),
    "retrieval_rank": Metric("rank of the true actions", optional=True),
    "retrieval_chance": Metric("retrieval by chance", optional=True, of_windows=True),
    "counterfactual_psnr": Metric("PSNR under other actions", "dB", optional=True),
    "counterfactual_copy": Metric("copying under other actions", "dB", optional=True, of_windows=True),
    "counterfactual_gain": Metric("counterfactual", "dB", optional=True, evaluated=True, compared=True),
    "action_error": Metric("error of actions", "variances", optional=True, evaluated=True, compared=True),
    "action_error_of_mean": Metric("of the mean action", optional=True),
    "action_gain": Metric("gain over the mean action", optional=True, evaluated=True),
}
"""All metrics, in the order of tables. Which of them an evaluation has depends on the model, its training and the
evaluation's settings."""

OPTIONAL_METRICS = tuple(name for name, metric in METRICS.items() if metric.optional)
"""Metrics that are nan for some windows: there is no other episode, there is no simulator of the robot, or the robot
has no actions to predict."""

OF_TOKENS = tuple(name for name, metric in METRICS.items() if metric.of_tokens)

OF_WINDOWS = tuple(name for name, metric in METRICS.items() if metric.of_windows)
