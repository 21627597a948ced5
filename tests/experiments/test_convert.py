"""`hma convert`, from an official checkpoint through every format and back."""

import json
import os
import re
import shlex
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from safetensors.numpy import load_file

from data_pipelines.registry import get_spec
from data_pipelines.registry.toml_file import load_entries
from experiments.cli.main import main
from experiments.presets import PRESETS, get_preset
from experiments.user_input.override import override
from hma_jax.config import ConfigError, DecodeConfig, SamplerConfig
from hma_jax.convert.release_limits import require_official
from hma_jax.convert.run_directory import fresh_state
from hma_jax.simulator.folder import DECODE, save_decode
from hma_jax.training.checkpoints import Checkpoints
from hma_jax.training.runs import describe_run, load_run
from tests.hma_jax.convert.fakes import CONTINUOUS, DISCRETE, make_checkpoint
from tests.tiny import TABLE

ROOT = Path(__file__).parents[2]
CHECKPOINT = ROOT / "tests" / "golden" / "04_discrete_mlp"


def test_a_checkpoint_goes_through_every_format_and_back(tmp_path, capsys):
    def convert(command: str, start: Path, out: str, *options: str) -> Path:
        assert main(["convert", command, str(start), "--out", str(tmp_path / out), *options]) == 0
        said = capsys.readouterr().out.replace("\n", "")
        assert (
            f"wrote {tmp_path / out}" in said
            and ("next: hma " in said or "note: " in said)
            and "robots: arm7, push2" in said
        )
        return tmp_path / out

    run = convert("from-official", CHECKPOINT, "run")
    neutral = convert("to-safetensors", run, "neutral")
    again = convert("from-safetensors", neutral, "again")
    back = convert("to-official", again, "back")
    came, went = (load_file(folder / "model.safetensors") for folder in (CHECKPOINT, back))
    assert {name: x.tobytes() for name, x in came.items()} == {name: x.tobytes() for name, x in went.items()}
    before, after = (json.loads((folder / "config.json").read_text()) for folder in (CHECKPOINT, back))
    assert before == after

    save_decode(DecodeConfig(3, 0.5, sampler=SamplerConfig("dpm++", 12, 0.5)), again / DECODE)
    program = convert("to-stablehlo", again, "program", "--platforms", "cpu", "--sampler-steps", "10")
    about = json.loads((program / "model.json").read_text())
    decode = about["program"]["decode"]  # of decode.json, as `hma play` has it, but for what is asked for
    assert (decode["unmask_steps"], decode["temperature"]) == (3, 0.5)
    assert (decode["sampler"]["kind"], decode["sampler"]["steps"]) == ("dpm++", 10)
    assert about["outputs"][0]["shape"] == [1, 1, 16]  # of a window of 3 frames 2 are given
    assert {path.name for path in program.iterdir()} == {"model.json", "model.safetensors", "model.stablehlo"}


def test_a_released_model_comes_with_the_rates_that_give_its_strides_and_the_commands_that_judge_it(tmp_path, capsys):
    """bridge_dataset has 5 Hz, of which the release makes stride 2 and the registry 3."""
    robots = [("bridge_dataset", 7, 2), ("push", 2, 1), ("fractal20220817_data", 3, 1)]
    start, run = make_checkpoint(tmp_path / "a", DISCRETE, robots), tmp_path / "run"
    assert main(["convert", "from-official", str(start), "--out", str(run)]) == 0
    said = capsys.readouterr().out
    (entry,) = load_entries(run / "rates.toml")
    assert entry.name == "bridge_dataset" and entry.rate == 2.5 and entry.stride == 2 != get_spec(entry.name).stride
    assert 'joins = ["DATASET"]' in (run / "rates.toml").read_text()
    assert "note: not in rates.toml: push, which the registry does not know" in said
    assert "fractal20220817_data (3 values, 10 here), whose actions differ from the registry's" in said
    command = said.split("next: ")[1].split("\nor: ")[0].replace("\\\n", "")
    first, second = (shlex.split(part) for part in command.split("&&"))
    assert first[:2] == ["hma", "tokenize"] and second[:3] == ["hma", "evaluate", str(run)] and first[2:] == second[3:]
    assert str(run / "rates.toml") in first and "model.frames=3" in first and "eval.prompt_frames=1" in first


def test_the_page_s_settings_sample_latents_as_the_release_does(tmp_path, capsys):
    """Added to the command that the conversion prints (reference sections 2.5, 3.3 and 6.1)."""
    start, run = make_checkpoint(tmp_path / "a", CONTINUOUS, [("push", 2, 1)], use_mup=False), tmp_path / "run"
    assert main(["convert", "from-official", str(start), "--out", str(run)]) == 0
    (preset,) = set(re.findall(r"--preset (\S+)", capsys.readouterr().out))
    (line,) = re.findall(
        r'^L="(--preset .*?)"$', (ROOT / "docs" / "checkpoints.md").read_text(), re.DOTALL | re.MULTILINE
    )
    assert f"--preset {preset} " in line
    study = override(get_preset(preset), re.findall(r"--set (eval\.\S+)", line))
    sampler = SamplerConfig("ddpm", 100, 0.0, scale_initial_noise=False)
    assert study.eval.decode == DecodeConfig(unmask_steps=4, sampler=sampler, resample=True)
    assert (study.eval.context, study.eval.windows_per_dataset) == ("recorded", 200)


def test_robots_whose_frames_are_others_here_get_no_rate_and_swapped_colours_are_said(tmp_path, capsys):
    """Of EPIC-KITCHENS the 15th of 50 or 60 frames a second is 0.3 s later; of the ten kept here it would be 1.5."""
    robots = [("epic_kitchen", 4, 15), ("ego4d", 4, 1)]
    start, run = make_checkpoint(tmp_path / "a", DISCRETE, robots), tmp_path / "run"
    assert main(["convert", "from-official", str(start), "--out", str(run)]) == 0
    said = capsys.readouterr().out
    assert [entry.name for entry in load_entries(run / "rates.toml")] == ["ego4d"]
    assert "note: not in rates.toml: epic_kitchen, of whose frames" in said
    assert "note: ego4d: the release trained on images with red and blue swapped" in said


def test_a_run_comes_to_its_place_with_its_rates(tmp_path, monkeypatch):
    """A kill after the run is there leaves nothing out: all of it is renamed at once."""
    start, run = make_checkpoint(tmp_path / "a", DISCRETE, [("bridge_dataset", 7, 2)]), tmp_path / "run"

    def killed(made, place, replace=os.replace):
        replace(made, place)
        if Path(place) == run:
            raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    main(["convert", "from-official", str(start), "--out", str(run)])
    assert [entry.rate for entry in load_entries(run / "rates.toml")] == [2.5] and load_run(run).step == 0


@pytest.mark.parametrize(("base", "loads"), [(DISCRETE, True), (CONTINUOUS, False)], ids=["discrete", "continuous"])
def test_what_the_release_does_not_load_is_not_said_to_load(base, loads, tmp_path, capsys):
    start, run, back = make_checkpoint(tmp_path / "a", base, [("push", 2, 1)]), tmp_path / "run", tmp_path / "back"
    assert main(["convert", "from-official", str(start), "--out", str(run)]) == 0
    assert ("note: use_mup is true and the width is 16" in capsys.readouterr().out) != loads
    assert main(["convert", "to-official", str(run), "--out", str(back)]) == 0
    said = capsys.readouterr().out.replace("\n", "")
    assert ("the official release loads it with STMaskGIT.from_pretrained" in said) == loads
    assert ("the release cannot load it" in said) != loads
    assert f"hma convert from-official {back} --out RUN" in said


@pytest.mark.parametrize(("asked", "taken"), [("", "ema"), ("ema", "ema"), ("last", "params")])
def test_the_average_of_the_weights_is_what_is_converted_unless_told_otherwise(asked, taken, tmp_path, capsys):
    assert main(["convert", "from-official", str(CHECKPOINT), "--out", str(tmp_path / "plain")]) == 0
    plain = load_run(tmp_path / "plain")
    run = replace(plain, train=replace(plain.train, ema_decay=0.5))
    state = fresh_state(run)._replace(ema=jax.tree.map(lambda x: np.asarray(x) + 1, plain.params))
    about = describe_run(run.model, run.train, run.table, run.provenance)
    with Checkpoints(tmp_path / "run" / "checkpoints", about) as checkpoints:
        checkpoints.save(7, state)
    weights = ["--weights", asked] if asked else []

    def convert(command: str, start: str, out: str, *options: str) -> int:
        return main(["convert", command, str(tmp_path / start), "--out", str(tmp_path / out), *options])

    assert convert("to-safetensors", "run", "neutral", *weights) == 0
    which = {"ema": "average", "params": "last"}[taken]
    assert f"{which} weights of step 7, robots: " in " ".join(capsys.readouterr().out.split())
    assert convert("from-safetensors", "neutral", "again") == 0
    again = load_run(tmp_path / "again")
    converted = {"step": 7, "weights": {"ema": "ema", "params": "last"}[taken]}
    assert (again.step, again.provenance) == (0, run.provenance | {"converted": converted})
    got, want = again.params, getattr(state, taken)
    for x, y in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        np.testing.assert_array_equal(x, y)
    assert convert("to-safetensors", "plain", "none", "--weights", "ema") == 2
    assert "keeps no average of its weights" in capsys.readouterr().err


def test_the_presets_that_can_go_out_are_those_that_the_page_names():
    """The others can with the settings that it gives, and need all of them."""
    page = " ".join((ROOT / "docs" / "checkpoints.md").read_text().split())
    released, forgetful = {"action_alignment": "released"}, {"recall": False}

    def leaves(changes: dict) -> bool:
        try:
            require_official(replace(preset.model, **changes), TABLE)
        except ConfigError:
            return False
        return True

    needed: dict[tuple[str, ...], list[str]] = {}
    for name, preset in PRESETS.items():
        ways = ({}, released, released | forgetful)
        needed.setdefault(tuple(next(way for way in ways if leaves(way))), []).append(name)
    as_they_are, and_both = sorted(needed[()]), sorted(needed["action_alignment", "recall"])
    listed = f"{', '.join(as_they_are[:-1])} and {as_they_are[-1]}"
    assert f"The settings of the presets {listed} can be exported as they are. The others need" in page
    assert f"{', '.join(and_both[:-1])} and {and_both[-1]} also `--set model.recall=false`" in page
    named = re.search(r"suite's forty have no actions \((.*?)\)", page)[1].split(", ")
    assert named == [name for name in PRESETS["accelerator"].dataset_names() if not get_spec(name).action_dims]
