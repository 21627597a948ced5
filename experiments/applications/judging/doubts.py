"""What to doubt in a judgement, and how good its success head is, in sentences for the page and the terminal."""

from __future__ import annotations

from typing import Any

from experiments.applications.judging.agreement import LEAST_POLICIES, LEAST_STARTS, count_interval
from experiments.applications.judging.recordings import LAST
from experiments.applications.judging.summary import COMPARED, CONTROL, MODEL, shown

MANY_BEYOND = 0.1
"""If more than this share of a policy's actions is clipped, it may use other units."""

NOTHING = (
    "The rates are compared with nothing outside the model: there is no true simulator, and no success counts of the real "
    "robot were given (--real). They come from the model and from the success head on its frames; either may be wrong, most "
    "of all for a policy that goes where no recording went. If a policy does as well in the control, where another "
    "episode's actions are executed, its success does not come from its actions."
)
"""What is said where there is no reference."""


def doubts_of_rates(summary: dict[str, Any]) -> list[str]:
    """All warnings except those about intervals over starts."""
    said = (describe_control, describe_order, describe_clipping, describe_few_policies)
    return [warning for describe in said if (warning := describe(summary))]


def doubts_of_starts(summary: dict[str, Any]) -> list[str]:
    """Why intervals over starts are missing."""
    return [warning for describe in (describe_few_starts, describe_one_apart) if (warning := describe(summary))]


def describe_control(summary: dict[str, Any]) -> str:
    """A warning that success in the model may not depend on the policies' actions; "" if it is known to."""
    above = summary["above the control"]
    if above["low"] > 0:
        return ""
    return (
        "It is not known that policies succeed more often in the model than in the control, where another episode's actions "
        f"are executed: the difference is {shown(above)} on average over policies. If there is none, the rates do not show "
        "what policies do, whatever they are compared with, or all starts are alike: look at the clips."
    )


def describe_order(summary: dict[str, Any]) -> str:
    """A warning that the control may order the policies as well as the model does; "" if the control's correlation is
    below the model's interval, or the model has none."""
    spearmans = {
        COMPARED[name]: agreed["policies and starts"]["spearman"] for name, agreed in summary["agreement"].items()
    }
    model, control = (spearmans.get(column) for column in (MODEL, CONTROL))
    if not model or model["low"] is None or control["mean"] is None or control["mean"] < model["low"]:
        return ""
    return (
        f"The control may order policies as well as the model does: Spearman's correlation is {control['mean']:.2f} in the "
        f"control, {shown(model)} in the model. So the model's order need not come from what the policies do. Compare it "
        "with that of a model trained without actions (--set train.masking.setting=passive)."
    )


def describe_clipping(summary: dict[str, Any]) -> str:
    """A warning that names the user's policies with many clipped actions; "" if there are none."""
    shares = {name: summary["actions beyond the range"][name] for name in summary["own"]}
    many = [f"{name} ({share:.0%})" for name, share in shares.items() if share > MANY_BEYOND]
    if not many:
        return ""
    return (
        f"Many actions lay outside what {summary['robot']} was ever given, and were clipped to it: of {', '.join(many)}. "
        "Are they raw, in the units of its recordings?"
    )


def describe_few_policies(summary: dict[str, Any]) -> str:
    """A warning that the agreement is based on few policies; "" if there are enough, or nothing is compared."""
    compared = compared_policies(summary)
    if not compared or len(compared) >= LEAST_POLICIES:
        return ""
    return (
        f"Only {len(compared)} policies are compared: how well they are told apart says little about others. Correlations and "
        f"rank violation have an interval over other policies from {LEAST_POLICIES} on, correlations a value from 3."
    )


def describe_few_starts(summary: dict[str, Any]) -> str:
    """Why there are no intervals over starts; "" if there are some, or nothing is compared."""
    if not summary["compared with"] or summary["starts"] >= LEAST_STARTS:
        return ""
    return (
        f"Correlations and rank violation have an interval over other starts from {LEAST_STARTS} starts on; these are "
        f"{summary['starts']}."
    )


def describe_one_apart(summary: dict[str, Any]) -> str:
    """Why Spearman's correlation alone has no interval over starts; "" otherwise."""
    if summary["starts"] < LEAST_STARTS:
        return ""
    spearmans = {name: agreed["starts"]["spearman"] for name, agreed in summary["agreement"].items()}
    without = [name for name, x in spearmans.items() if x["mean"] is not None and x["low"] is None]
    if not without:
        return ""
    return (
        f"Over other starts Spearman's correlation has no interval in: {', '.join(without)}. There the rate of one policy is "
        "far from all others, and would be taken for their order."
    )


def compared_policies(summary: dict[str, Any]) -> list[str]:
    """Policies with a rate outside the model."""
    column = summary["compared with"]
    return [name for name, rates in summary["policies"].items() if column and rates[column]["mean"] is not None]


def describe_head(summary: dict[str, Any]) -> str:
    """A sentence on the accuracy of the success head, or of the user's function, on held-out episodes."""
    measured = summary["head"]
    usual = max(measured["positive"], 1 - measured["positive"])
    doubt = "" if measured["frame accuracy"] > usual else " It is no better than that: do not trust the rates."
    return (
        f"{'That of the file with the policies. ' if summary['own success'] else ''}"
        f"On {measured['episodes']:.0f} recorded {'' if 'successes' in measured else 'true '}episodes that no head was "
        f"trained on: accuracy of frames {measured['frame accuracy']:.3f}, AUROC {measured['frame AUROC']:.3f}, accuracy of "
        f"episodes {measured['episode accuracy']:.3f}. The more frequent label is right for {usual:.3f} of the frames.{doubt}"
    )


def describe_recorded_head(measured: dict[str, float]) -> str:
    """Sentences on the accuracy of a head that learnt from recordings, on held-out ones; "" for other heads."""
    if "successes" not in measured:
        return ""
    n, good = round(measured["episodes"]), round(measured["successes"])
    correct = round(measured["successes told"]), round(measured["failures told"])
    accuracy, usual = count_interval(sum(correct), n), max(good, n - good) / n
    doubt = "" if accuracy.low > usual else " So few do not show that it is better: do not trust the rates."
    learnt = (
        f"It was trained on {measured['learnt from']:.0f} recordings, {measured['successes among them']:.0f} of them successes; "
        if "learnt from" in measured
        else "Of the recordings "
    )
    taken = (
        " No recording says at which frames its goal is reached. Assumed is that no frame of a failure shows it, none of the "
        f"first half of a success, and each of the last {measured[LAST]:.0f} of a success. Where a failure passes its goal, or "
        "a success reaches it early, the head was trained on wrong labels; rewards of every step (--reward) avoid this."
        if LAST in measured
        else ""
    )
    return (
        f"It recognises {correct[0]} of {good} successes and {correct[1]} of {n - good} failures: {accuracy.mean:.2f} "
        f"({accuracy.low:.2f} to {accuracy.high:.2f}) of all, {measured['episode accuracy, decoded']:.2f} of them as the "
        f"model's tokenizer decodes them. The more frequent outcome is right for {usual:.2f} of them.{doubt} {learnt}"
        f"left out were {measured['unknown']:.0f} that do not say whether they succeeded, and {measured['too short']:.0f} that are too short.{taken}"
    )
