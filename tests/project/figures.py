"""Prints figures of the house, which are to fall: `python tests/project/figures.py`.

Lines and tokens of source and tests; functions above 80 lines of code; places that assemble a fit, look at a folder of
results or lock it; packages that write their public names twice. Kernels may be long: each is one loop.
"""

import ast
import io
import sys
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[2]
SOURCE = ("kgs", "losses", "datasets")
LONGEST = 80  # lines of code of a function, without its docstring, comments and empty lines
_SKIPPED = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
# what is asked or put together in one place, by the functions that do it
ONCE = {
    "assembly of a fit": ("hooks.make_trainer",),
    "a folder of results is looked at": ("_check_folder",),
    "a folder of results is locked": ("FileLock",),
}


def files(*folders: str) -> list[Path]:
    return [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]


def size(paths: list[Path]) -> tuple[int, int]:
    """Lines, and tokens without comments and line ends."""
    texts = [path.read_text(encoding="utf-8") for path in paths]
    tokens = [token for text in texts for token in tokenize.generate_tokens(io.StringIO(text).readline)]
    return sum(text.count("\n") for text in texts), sum(token.type not in _SKIPPED for token in tokens)


def nodes(path: Path) -> list[ast.AST]:
    return [*ast.walk(ast.parse(path.read_text(encoding="utf-8")))]


def lines_of_code(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines that hold a part of a statement of a function's body, its docstring apart."""
    body = function.body[1:] if ast.get_docstring(function) else function.body
    spans = [(node.lineno, node.end_lineno) for part in body for node in ast.walk(part) if isinstance(node, ast.expr)]
    spans += [(node.lineno, node.lineno) for part in body for node in ast.walk(part) if isinstance(node, ast.stmt)]
    return len({line for first, last in spans for line in range(first, (last or first) + 1)})


def long_functions(path: Path) -> list[str]:
    """Functions of a file that are longer than `LONGEST`."""
    nodes = [
        node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.FunctionDef)
    ]
    name = path.relative_to(ROOT).as_posix()
    return [f"{name}:{node.name} ({lines_of_code(node)})" for node in nodes if lines_of_code(node) > LONGEST]


def calls(path: Path, names: tuple[str, ...]) -> list[str]:
    """The places in a file that call one of these functions."""
    found = [node for node in nodes(path) if isinstance(node, ast.Call) and ast.unparse(node.func) in names]
    return [f"{path.relative_to(ROOT).as_posix()}:{node.lineno}" for node in found]


def main() -> None:
    source = files(*SOURCE)
    kernels = [path for path in source if path.stem.endswith("_kernels")]
    for name, paths in (("source", source), ("tests", files("tests"))):
        lines, tokens = size(paths)
        print(f"{name}: {lines} lines, {tokens} tokens")
    long = [found for path in source if path not in kernels for found in long_functions(path)]
    print(f"functions above {LONGEST} lines of code: {len(long)} {' '.join(long)}")
    for what, names in ONCE.items():
        places = [place for path in source for place in calls(path, names)]
        print(f"{what}: {len(places)} {' '.join(places)}")
    twice = [path for path in source if path.stem == "__init__" and "TYPE_CHECKING" in path.read_text(encoding="utf-8")]
    print(f"TYPE_CHECKING in __init__: {len(twice)} {' '.join(path.parent.name for path in twice)}")


if __name__ == "__main__":
    sys.exit(main())
