"""Command line: `graspd admin`, whose commands `graspd.cli.JOINED` lists."""

import typer

app = typer.Typer()
app.add_typer(
    typer.Typer(no_args_is_help=True, help="Rare tasks: compile kernels, rebuild the index, repair the store, draw."),
    name="admin",
)
