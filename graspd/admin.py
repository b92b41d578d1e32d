"""Command line: `graspd admin`. `graspd.cli.JOINED` lists its commands."""

import typer

app = typer.Typer()
app.add_typer(typer.Typer(no_args_is_help=True, help="Maintenance of kernels, index and store."), name="admin")
