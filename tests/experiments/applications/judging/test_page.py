"""The page of a judgement explains its own words, and no others."""

from experiments.applications.judging.page import _policies
from experiments.applications.judging.summary import MODEL


def test_policies_that_were_not_judged_are_not_explained():
    """Every page spoke of Diffusion Policies and of a policy "hma", which were in few tables."""
    judged = {
        "own": ["mine-2"],
        "policies": dict.fromkeys(("random", "cloned-60", "cloned-3000", "mine-2"), {MODEL: {}}),
    }
    said = _policies(judged)
    assert said.count("<em>cloned-N</em>: behaviour cloning, after N training steps") == 1
    assert "<em>random</em>" in said and not any(name in said for name in ("hma", "iffusion", "mine"))
    judged["policies"] |= {"diffusion-60": {}, "hma": {}}
    assert all(f"<em>{name}</em>: " in _policies(judged) for name in ("diffusion-N", "hma"))
