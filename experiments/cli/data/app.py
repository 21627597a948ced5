"""`hma data`: its commands by name, and the command that writes the study's own suite."""

from __future__ import annotations

from experiments.cli.arguments import ReplaceOptions, StudyOptions
from experiments.cli.data import convert, registry, sim
from experiments.cli.data.export import data_export
from experiments.cli.data.view import view
from experiments.study_setup import make_setup
from experiments.terminal.command_line import Commands
from experiments.terminal.progress import wrote

HELP = "List, inspect, view, convert, export and simulate datasets."

CONVERT_HELP = (
    "Convert other formats into an RLDS directory, for other programs: this one also reads LeRobot and robomimic "
    "directly. Needs the extra 'convert' (pip install 'hma-jax[convert]'). Run the same command again after an "
    "interruption: it continues."
)


def suite(arguments: StudyOptions, replacement: ReplaceOptions) -> None:
    """Write the study's simulated datasets as RLDS directories."""
    from experiments.preparing.suite import make_suite

    setup = make_setup(arguments)
    with setup.workspace.locked():
        make_suite(setup.study, setup.workspace, replacement.replace)
    wrote(setup.workspace.suite, then=setup.command("tokenize" if setup.tokenizer else "tokenizer train"))


convert_app = Commands()
convert_app.command(name="robomimic")(convert.robomimic)
convert_app.command(name="lerobot")(convert.lerobot)
convert_app.command(name="epic-kitchens")(convert.epic_kitchens)
convert_app.command(name="ego4d")(convert.ego4d)
convert_app.command(name="egoexo4d")(convert.egoexo4d)

data_app = Commands()
data_app.command(name="list")(registry.data_list)
data_app.command(name="inspect")(registry.data_inspect)
data_app.command(name="view")(view)
data_app.command(name="suite")(suite)
data_app.command(name="import-tokens")(convert.import_tokens)
data_app.command(name="export")(data_export)
data_app.command(name="sim")(sim.data_sim)
data_app.command(name="sim-table")(sim.data_sim_table)
data_app.command(convert_app, name="convert", help=CONVERT_HELP)
