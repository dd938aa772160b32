"""The settings of a training run as options of the command line.

Made from `training.options.TrainOptions` when `train` is called, so that other commands stay fast.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from colmap_netvlad.terminal import Command

if TYPE_CHECKING:
    from colmap_netvlad.training.options import TrainOptions


class SettingsCommand(Command):
    """A command that also takes every setting of `TrainOptions`, as `--name-of-setting`."""

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """Return the command's own parameters and the settings."""
        own = super().get_params(ctx)
        return [*own[:-1], *_settings(), own[-1]]  # --help stays last


def _settings() -> list[click.Parameter]:
    from dataclasses import fields

    from colmap_netvlad.training.options import TrainOptions

    made: list[click.Parameter] = []
    for item in fields(TrainOptions):
        choices = item.metadata.get("choices")
        kind = item.metadata.get("type", type(item.default))
        flag = f"--{item.name.replace('_', '-')}"
        made.append(
            click.Option(
                [f"{flag}/--no-{flag[2:]}" if kind is bool else flag],
                type=None if kind is bool else (click.Choice(choices) if choices else kind),
                default=item.default,
                show_default=item.default is not None,
                help=item.metadata["help"],
            )
        )
    return made


def settings_of(context: click.Context, recipe: Path | None) -> TrainOptions:
    """Return the settings: defaults, then the recipe's, then those given on the command line.

    Raises:
        InputError: the recipe cannot be read, or a setting cannot work.
    """
    from dataclasses import fields

    from colmap_netvlad.training.options import TrainOptions, read_recipe

    chosen: dict[str, Any] = read_recipe(recipe) if recipe else {}
    for item in fields(TrainOptions):
        if context.get_parameter_source(item.name) is ParameterSource.COMMANDLINE:
            chosen[item.name] = context.params[item.name]
    return TrainOptions(**chosen)
