"""The verbs: `pav VERB`, `python -m pav_blender VERB`, `blender --command pav VERB`.

Exit codes: 0 done, 1 a claim or a job failed or was stopped, 2 wrong input.
Each verb is a module with `SUMMARY`, `EXAMPLE`, `add_arguments(parser)` and `run(args) -> int`;
it is imported only when its verb is asked for.
"""

from __future__ import annotations

import argparse
import importlib
import keyword
import os
import sys
from collections.abc import Sequence

VERBS = {
    "demo": "the main job on the built-in person: collection, avatar, Blender scene, pictures",
    "studio": "render a collection of clips of a synthetic person with Cycles",
    "track": "make a collection from videos of one person",
    "import": "make a collection of what other trackers and avatar systems wrote",
    "check": "validate and summarise a collection, with an overlay picture",
    "train": "train an avatar on a collection",
    "render": "render an avatar along a track to an image sequence",
    "frames": "find and clear empty, torn and missing frames in folders of pictures",
    "bake": "a textured mesh of an avatar, for programs that cannot run its field",
    "export": "a collection in INSTA's or VHAP's layout, or as posed meshes",
    "head": "a head file out of any Blender mesh with shape keys",
    "scene": "build a Blender scene of an avatar on a track",
    "table": "reproduce a table of the paper, or of what sets ours apart from it",
    "eval": "measure an avatar on frames it has not seen, with the field's metrics",
    "bench": "measure speed against error: render, accuracy, train, kernels, scale, matte, track",
    "stress": "hostile scenes: what must hold in each, and what was seen",
    "info": "what an avatar file holds",
    "doctor": "what this machine offers: packages, versions, threads",
}


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line; the usage is a `--help` away."""

    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(2, f"{self.prog}: {message}; see `{self.prog} --help`\n")


def main(argv: Sequence[str]) -> int:
    """Runs one verb and returns its exit code."""
    _one_blas_thread()
    from .core.errors import Cancelled, InputError, PavError

    parser = _Parser(prog="pav", description=__doc__.splitlines()[0], add_help=True)
    listing = "\n".join(f"  {verb:8} {text}" for verb, text in VERBS.items())
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = f"verbs:\n{listing}\n\n`pav VERB --help` tells more."
    parser.add_argument("verb", choices=VERBS, metavar="VERB")
    parser.add_argument("rest", nargs=argparse.REMAINDER, help=argparse.SUPPRESS)
    try:
        chosen = parser.parse_args(argv[:1] if argv else [])
        return _run(chosen.verb, list(argv[1:]))
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 2
    except InputError as error:
        return _fail(error, 2)
    except Cancelled as error:
        return _fail(error, 1)
    except PavError as error:
        return _fail(error, 1)
    except KeyboardInterrupt:
        return _fail("stopped", 1)
    except BrokenPipeError:  # the reader of our output went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1


def run() -> None:
    """Entry point of the `pav` command."""
    sys.exit(main(sys.argv[1:]))


def _run(verb: str, argv: list[str]) -> int:
    name = f"{verb}_" if keyword.iskeyword(verb) else verb
    module = importlib.import_module(f".verbs.{name}", __package__)
    parser = _Parser(
        prog=f"pav {verb}",
        description=module.SUMMARY,
        epilog=f"example:\n  {module.EXAMPLE}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.add_arguments(parser)
    parser.add_argument("--threads", type=int, help="processor cores to use (default: all)")
    if "--json-progress" not in parser._option_string_actions:
        parser.add_argument(
            "--json-progress", action="store_true", help="progress as one JSON line a step"
        )
    args = parser.parse_args(argv)
    _limit_threads(args.threads)
    return int(module.run(args))


def _one_blas_thread() -> None:
    """Our own pool gives every core a piece of its own; BLAS' threads beside it wait, spinning, for
    cores that are taken: a track took 1.5 times as long, and on a busy machine 10 times. Before
    numpy is imported, for it asks once."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _limit_threads(wanted: int | None) -> None:
    """numba's pool and torch's share one number, so that they do not crowd each other."""
    from .core.errors import InputError

    if wanted is not None:
        if wanted < 1:
            raise InputError(f"--threads {wanted}: at least 1")
        os.environ["PAV_THREADS"] = str(wanted)
        os.environ.setdefault("OMP_NUM_THREADS", str(wanted))
        torch = sys.modules.get("torch")
        if torch is not None:
            torch.set_num_threads(wanted)


def _fail(message: object, code: int) -> int:
    text = " ".join(str(message).split())
    print(f"pav: {text}", file=sys.stderr, flush=True)
    return code
