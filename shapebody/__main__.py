"""Command line: python -m shapebody COMMAND ..., with --help for each of them.

Every setting of a configuration can be given: `train unitree_go2 --task.horizon 500`.
"""

import os
import sys

# Actor and learner share the cores of a CPU; XLA's own thread pool would get in their way.
# It must be said before JAX starts.
_FLAG = "--xla_cpu_multi_thread_eigen=false"


def main(arguments=None) -> int:
    """Run a command; returns its exit status. Errors are one line on stderr."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        status = _run(words)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # whoever read the output, such as `head`, has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def _run(words: list[str]) -> int:
    import tyro

    from shapebody.commands import COMMANDS

    if not words or words[0] not in COMMANDS:
        asked = bool(words) and words[0] in ("-h", "--help")
        wrong = "" if asked or not words else f"shapebody: no command {words[0][:80]!r}\n"
        print(wrong + _usage(COMMANDS), file=sys.stdout if asked else sys.stderr)
        return 0 if asked else 2
    name, words = words[0], words[1:]
    if name in ("train", "continue", "anneal", "policy-evaluation"):
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {_FLAG}".strip()
    try:
        command, words = COMMANDS[name](words)
        prog = f"python -m shapebody {name}" + " ROBOT [ROBOT ...]" * (name == "train")
        return tyro.cli(command, prog=prog, args=words) or 0
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ImportError) as error:
        print(f"shapebody: {_with_option(str(error), words)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("shapebody: interrupted", file=sys.stderr)
        return 130


def _with_option(message: str, words: list[str]) -> str:
    """A message such as "trust_region is -1; ..." with the name of the option that was typed."""
    name, space, rest = message.partition(" ")
    option = f"--{name.replace('_', '-')}"
    typed = any(word == option or word.startswith(f"{option}=") for word in words)
    return option + space + rest if typed and rest.startswith("is ") else message


def _usage(commands) -> str:
    width = max(map(len, commands))
    lines = [f"  {name:{width}}  {make.__doc__}" for name, make in commands.items()]
    return "usage: python -m shapebody COMMAND [--help] ...\n\n" + "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
