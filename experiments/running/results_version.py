"""The version of what trials compute, which is part of every trial's name."""

CHANGES = {
    1: "the first that is numbered; before, the bytes of the sources were part of a trial's name",
    2: "action-nats, retrieval of the true actions and, on the suite, counterfactual PSNR are measured",
}
"""What each number changed. Add one when a change to the code alters the numbers of a trial whose configuration and
inputs stay as they are: finished trials of the previous number are then different trials, and cannot be mistaken for
new ones. Changes to tokenizers, tokens or windows need none: these are named by their content. A change that alters
nothing beyond rounding keeps the number; the sources that each trial ran are recorded beside it (`provenance`)."""

RESULTS_VERSION = max(CHANGES)

OF_SOME = {
    "a frame's own action is told from earlier ones by its weight": {"model.conditioning": "cross_attention"},
    "robots without actions have no error of predicted actions": {"model.action_heads": True},
    "stems learn from hidden actions that leak into blocks": {"train.masking.action_leak": "conditioning"},
    "stems learn from hidden actions that leak": {"train.masking.action_leak": "all"},
    "an own past is drawn after hidden actions that leak into blocks": {
        "train.masking.teacher_forcing": True,
        "train.masking.action_leak": "conditioning",
    },
    "an own past is drawn after hidden actions that leak": {
        "train.masking.teacher_forcing": True,
        "train.masking.action_leak": "all",
    },
    "no leak into blocks shows the first frame an action that comes after it": {
        "model.action_alignment": "causal",
        "train.masking.action_leak": "conditioning",
    },
    "no leak shows the first frame an action that comes after it": {
        "model.action_alignment": "causal",
        "train.masking.action_leak": "all",
    },
    "a robot without actions has none that leak into blocks": {"train.masking.action_leak": "conditioning"},
    "a robot without actions has none that leak": {"train.masking.action_leak": "all"},
    "what rounding leaves is no scale of actions": {"train.action_scale": "quantiles"},
    "frames of what predicts none are not judged: a policy": {"train.masking.setting": "policy"},
    "frames of what predicts none are not judged: inverse dynamics": {"train.masking.setting": "inverse"},
    "inverse dynamics is not asked for what follows the last frame": {"train.masking.setting": "inverse"},
    "the gain of recall does not decay in a policy": {"model.recall": True, "train.masking.setting": "policy"},
    "the gain of recall does not decay in inverse dynamics": {"model.recall": True, "train.masking.setting": "inverse"},
    "the average of a robot's weights goes on in steps without it": {"train.ema_decay": lambda decay: decay > 0},
    "the average soon forgets the initial weights": {"train.ema_decay": lambda decay: decay > 0},
}
"""Changes that alter the numbers of only a few trials: those whose fields have these values, or values for which the
function is true. They are part of the names of these trials, and all others stay finished."""
