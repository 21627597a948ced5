"""What the release's muP set-up does to every parameter, against what our declarations say."""

from __future__ import annotations

import json

from hma_jax.config import ModelConfig
from hma_jax.convert.table import official_parts
from hma_jax.model.params import ParamSpec
from hma_jax.training.optimizer import learning_rate_multiplier
from tests.golden.case import Case, Finding


def rules(spec: ParamSpec, model: ModelConfig) -> dict[str, float]:
    """Of one of our parameters: its learning rate, its decay and the axes that grow with width."""
    rate = learning_rate_multiplier(spec, model)
    # The release's decay is multiplied by the learning rate; ours is not (`apply_update`).
    return {"lr_multiplier": rate, "weight_decay_multiplier": (1 / rate) if spec.decay else 0.0}


def check_mup_table(case: Case) -> None:
    """Learning rate, decay and growing axes of every parameter that the case lists."""
    recorded = json.loads((case.folder / "mup_table.json").read_text())["parameters"]
    leaves, model = case.declared.leaves(), case.run.model
    parts = official_parts(model, case.table, leaves)
    ours = {part.name: path for path, own in parts.items() for part in own}
    wrong, checked = [], 0
    for name, want in recorded.items():
        if name not in ours:
            wrong.append(f"{name}: no such parameter")
            continue
        spec = leaves[ours[name]]
        for rule, got in rules(spec, model).items():
            checked += 1
            if abs(got - want[rule]) > 1e-6:
                wrong.append(f"{name}: {rule} {got:g}, expected {want[rule]:g}")
        # Roles that say how many axes grow; a vector may have one or none.
        axes = {"hidden": (2,), "input": (1,), "output": (1,), "vector": (0, 1)}[spec.role]
        if want["infinite_dims"] not in axes:
            wrong.append(f"{name}: {want['infinite_dims']} axes grow with width, our role is {spec.role}")
    note = "; ".join(wrong[:5]) if wrong else f"{checked} multipliers of {len(recorded)} parameters"
    case.add(Finding("mup_table.json", not wrong, note=note))
