"""The commands of the program, and the options that go with any of them."""

from __future__ import annotations

import os
from typing import Annotated, Any, Literal

from cyclopts import App, Group, Parameter

from trackwright.experiments.cli.arguments import new_app
from trackwright.trackers.core.errors import UnusableInput

ABOUT = "Trackers for wireless indoor positioning: how accurate, with which noise levels?"

COMMANDS = {
    "import": "cli.import_source:import_source",
    "check": "cli.check:check",
    "survey": "cli.survey:survey",
    "calibrate": "cli.check:calibrate_recordings",
    "track": "cli.track:track",
    "evaluate": "cli.track:evaluate_tracks",
    "export": "cli.export:export",
    "tune": "cli.tune:tune",
    "sweep": "cli.tune:sweep",
    "trackers": "cli.trackers:trackers",
    "simulate": "cli.simulate:simulate",
    "study": "cli.study:study",
    "demo": "lab.demo:demo",
}
"""Where each command is. All these modules are light: what a command computes with is imported when it runs."""

ANY_COMMAND = Parameter(group=Group("With any command", sort_key=9))


def application() -> App:
    """The program with its commands, each imported when it is used; `meta` has the options that go with any of them."""
    app = new_app("trackwright", ABOUT, _version)
    for name, place in COMMANDS.items():
        app.command(f"trackwright.experiments.{place}", name=name, sort_key=len(app._commands))

    @app.meta.default
    def launch(
        *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
        quiet: Annotated[bool, ANY_COMMAND, Parameter(alias="-q")] = False,
        no_cache: Annotated[bool, ANY_COMMAND] = False,
    ) -> Any:
        """Run a command.

        Args:
            words: the command and its arguments.
            quiet: neither progress nor notices; results and errors alone.
            no_cache: neither read nor write compiled programs, which are kept in $TRACKWRIGHT_CACHE, by default your
                cache directory.
        """
        if no_cache:
            os.environ["TRACKWRIGHT_CACHE"] = "off"
        if quiet:
            from trackwright.experiments.text.terminal import ERRORS

            ERRORS.quiet = True
        return app(words)

    # Ctrl-C is answered in `main`.
    app.meta.suppress_keyboard_interrupt = False

    @app.command(name="--install-completion", group=ANY_COMMAND.group)
    def install_completion(*, shell: Literal["bash", "zsh", "fish", "powershell"] | None = None) -> None:
        """Install the completion of your shell.

        Args:
            shell: default: the one that the command is run from.
        """
        from cyclopts.completion import ShellDetectionError

        try:
            print(f"wrote {app.install_completion(shell=shell)}; open a new shell to use it")
        except ShellDetectionError:
            raise UnusableInput("--install-completion: no known shell found; give --shell") from None
        except OSError as error:
            raise UnusableInput(f"{error.filename}: cannot be written ({error.strerror}); check HOME") from error

    return app


def _version() -> str:
    from trackwright import __version__

    return f"trackwright {__version__}"
