"""Print a shell's completion script (`traps completion`)."""

import argparse

from traps_pipeline.base.paths import ASSETS
from traps_pipeline.cli.command import OK, SHORT_NAMES, Commands

SCRIPT = """# {use}
{zsh}_traps() {{
  local current=${{COMP_WORDS[COMP_CWORD]}} words="{top}"
  local first=${{COMP_WORDS[1]}} second=${{COMP_WORDS[2]}}
  if [ "$COMP_CWORD" -gt 1 ]; then
    case "$first $second" in
{cases}
      *) words="" ;;
    esac
  fi
  COMPREPLY=($(compgen -W "$words" -- "$current"))
}}
complete -o default -F _traps traps"""  # complete files if no word fits
USE = {"bash": 'eval "$(traps completion bash)"', "zsh": 'eval "$(traps completion zsh)"'}


def add(commands: Commands) -> None:
    """Add `traps completion` to the parser."""
    text = "print a script that lets a shell complete commands, options and experiments"
    parser = commands.add("completion", completion, text, example="bash", workspace=False)
    parser.add_argument("shell", choices=tuple(USE))
    parser.set_defaults(known=commands.by_name)


def completion(arguments: argparse.Namespace) -> int:
    commands, experiments = (arguments.known, sorted(path.stem for path in (ASSETS / "experiments").glob("*.yaml")))
    groups = dict.fromkeys(path.split()[0] for path in commands if " " in path)
    cases = list[str]()
    for path, parser in commands.items():
        group, _, name = path.rpartition(" ")
        patterns = [f"'{path}'"] if group else [f"'{name} '*"]
        patterns += [f"'{name} '*"] if name in SHORT_NAMES else []
        words = [*parser.options(), *(experiments if "experiment" in parser.format_usage() else ())]
        cases.append(f'      {"|".join(patterns)}) words="{" ".join(words)}" ;;')
    for group in groups:
        names = " ".join(path.split()[1] for path in commands if path.startswith(f"{group} "))
        cases.append(f"      '{group} '*) words=\"{names}\" ;;")
    zsh = "autoload -U +X compinit bashcompinit; compinit; bashcompinit\n" if arguments.shell == "zsh" else ""
    top = " ".join([*groups, *SHORT_NAMES, *(path for path in commands if " " not in path)])
    print(SCRIPT.format(use=USE[arguments.shell], zsh=zsh, top=top, cases="\n".join(cases)))
    return OK
