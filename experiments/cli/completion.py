"""`trackwright completion`: the completion script of a shell, made of the commands' own options."""

from __future__ import annotations

from typing import Annotated, Literal

from experiments.cli.arguments import arguments_of
from experiments.cli.summaries import COMMANDS, TRACKERS

BASH = """\
# trackwright completion for bash; in zsh after `autoload -U bashcompinit && bashcompinit`
_trackwright() {{
  local word=${{COMP_WORDS[COMP_CWORD]}} before=${{COMP_WORDS[COMP_CWORD-1]}} command=${{COMP_WORDS[1]}} options
  if [[ $COMP_CWORD == 1 ]]; then
    COMPREPLY=($(compgen -W "{commands}" -- "$word")); return
  fi
  if [[ $before == --tracker || ($before == tunables && $COMP_CWORD == 2) ]]; then
    COMPREPLY=($(compgen -W "{trackers}" -- "$word")); return
  fi
  case "$command ${{COMP_WORDS[2]}}" in
{cases}
  esac
  if [[ $word == -* ]]; then
    COMPREPLY=($(compgen -W "$options --help --quiet --no-cache" -- "$word"))
  else
    COMPREPLY=($(compgen -f -- "$word"))
  fi
}}
complete -o filenames -F _trackwright trackwright
"""


def completion(shell: Annotated[Literal["bash", "zsh", "fish"], "bash|zsh|fish"]) -> int:
    """Print the completion script of a shell: bash, zsh or fish.

    bash: trackwright completion bash > ~/.local/share/bash-completion/completions/trackwright

    zsh: trackwright completion zsh >> ~/.zshrc

    fish: trackwright completion fish > ~/.config/fish/completions/trackwright.fish

    Args:
        shell: the shell.
    """
    print({"bash": _bash, "zsh": _zsh, "fish": _fish}[shell](), end="")
    return 0


def _options() -> dict[str, list[str]]:
    """The options of every command."""
    from experiments.cli.main import FUNCTIONS, function_of

    return {
        name: [argument.name for argument in arguments_of(function_of(name)) if not argument.positional]
        for name in FUNCTIONS
    }


def _families() -> dict[str, list[str]]:
    """The second words of commands of two words, by the first."""
    found: dict[str, list[str]] = {}
    for first, _, second in (name.partition(" ") for name in COMMANDS):
        if second:
            found.setdefault(first, []).append(second)
    return found


def _bash() -> str:
    cases = []
    for name, options in _options().items():
        pattern = f'"{name}"*' if " " in name else f'"{name} "*'
        cases.append(f'    {pattern}) options="{" ".join(options)}" ;;')
    for first, seconds in _families().items():
        words = " ".join(seconds)
        cases.append(f'    "{first} "*) COMPREPLY=($(compgen -W "{words}" -- "$word")); return ;;')
    commands = " ".join(dict.fromkeys(name.partition(" ")[0] for name in COMMANDS))
    return BASH.format(commands=commands, trackers=" ".join(TRACKERS), cases="\n".join(cases))


def _zsh() -> str:
    return "autoload -U compinit bashcompinit && compinit && bashcompinit\n" + _bash()


def _fish() -> str:
    lines = ["# trackwright completion for fish"]
    names = dict.fromkeys(name.partition(" ")[0] for name in COMMANDS)
    first = "not __fish_seen_subcommand_from " + " ".join(names)
    for name in names:
        about = COMMANDS.get(name, "")
        lines.append(f"complete -c trackwright -n '{first}' -f -a {name} -d '{about}'")
    for family, seconds in _families().items():
        lines.append(f"complete -c trackwright -n '__fish_seen_subcommand_from {family}' -f -a '{' '.join(seconds)}'")
    for name, options in _options().items():
        seen = " ".join(name.split()[-1:])
        for option in options:
            extra = f" -x -a '{' '.join(TRACKERS)}'" if option == "--tracker" else ""
            lines.append(f"complete -c trackwright -n '__fish_seen_subcommand_from {seen}' -l {option[2:]}{extra}")
    return "\n".join(lines) + "\n"
