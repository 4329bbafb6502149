"""Write docs/api.md: all public names of ``jaxfit`` and its namespaces, from their signatures and docstrings."""

import argparse
import dataclasses
import importlib
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import jaxfit
from jaxfit.data.outputs import atomic_write
from jaxfit.schemes import Scheme

API = Path(__file__).resolve().parents[1] / "docs" / "api.md"
NAMESPACES = (
    *("cascade", "data", "errors", "evaluation", "export", "fitting", "heads", "labels", "learning", "models", "runs"),
    *("schemes", "experiments", "serving"),
)
_CONSTANTS = {  # they have no docstrings
    "FORMATS": "How each format of labelled faces is read, by name",
    "METHODS": "The methods that can be trained, by name",
    "NORMALISERS": "The lengths that errors can be relative to",
    "PROTOCOLS": "Published protocols of comparisons, by name",
    "SCHEMES": "The landmark schemes, by name",
}
_ABOUT = """Made from the docstrings by `python scripts/build_api.py`: first what most people need, then each namespace.
`N` counts faces, `L` landmarks, `H` and `W` the rows and columns of a picture. Pixels have their centres at whole
numbers, x to the right and y down; boxes are x, y, width and height; angles are roll, pitch and yaw in degrees."""
_SECTIONS = ("Args", "Attributes", "Returns", "Yields", "Raises")
_WIDTH = 100  # of a signature, from which each parameter has a line
_MADE_BY_USERS = ("FolderRun", "Pipeline", "Source")  # beside classes whose attributes all have defaults


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.parse_args()
    with atomic_write(API, "w") as file:
        file.write(reference())
    return 0


def modules() -> dict[str, ModuleType]:
    """The package and its namespaces, by what users write."""
    names = ["jaxfit", *(f"jaxfit.{name}" for name in NAMESPACES)]
    found = {name: importlib.import_module(name) for name in names if name != "jaxfit.export"}
    return {name: found.get(name, jaxfit.export) for name in names}  # whose module lies elsewhere


def public_names(module: ModuleType) -> list[str]:
    """The public names of a module, but for the namespaces."""
    own = [name for name, thing in vars(module).items() if getattr(thing, "__module__", "") == module.__name__]
    names = getattr(module, "__all__", [name for name in own if not name.startswith("_")])
    return sorted((name for name in names if not inspect.ismodule(getattr(module, name))), key=str.lower)


def reference() -> str:
    """The whole page, as Markdown."""
    places: dict[int, str] = {}  # where each thing is described: where it comes first
    contents, parts = [], []
    for path, module in modules().items():
        names = public_names(module)
        new = [name for name in names if id(getattr(module, name)) not in places]
        places |= {id(getattr(module, name)): f"{path}.{name}" for name in new}
        links = [f"[`{name}`](#{_anchor(places[id(getattr(module, name))])})" for name in names]
        contents.append(f"- **{path}**: {', '.join(links)}")
        if path != "jaxfit":
            parts += [f"## Namespace {path}", _prose(inspect.getdoc(module) or "")]
        for name in new:
            parts += _entry(f"{path}.{name}", getattr(module, name))
    return "\n\n".join(["# API reference", _ABOUT, "\n".join(contents), "## The top level", *parts]) + "\n"


def description(name: str, thing: Any) -> str:
    """What a public thing is for: its docstring, or what stands here for a constant; empty if nothing says it."""
    if inspect.isclass(thing) or inspect.isroutine(thing):
        return inspect.getdoc(thing) or ""
    if isinstance(thing, Scheme):
        return f"The landmark scheme `{thing.name}` of {thing.count} landmarks."
    return f"{_CONSTANTS[name]}: {', '.join(f'`{each}`' for each in thing)}." if name in _CONSTANTS else ""


def _anchor(path: str) -> str:
    return path.replace(".", "").lower()


def _entry(path: str, thing: Any) -> Iterator[str]:
    yield f"### {path}"
    if inspect.isroutine(thing) or (inspect.isclass(thing) and _made_by_users(thing)):
        yield f"```python\n{_signature(path, thing)}\n```"
    yield from _described(description(path.rpartition(".")[2], thing))
    members = vars(thing) if inspect.isclass(thing) else {}
    for name, member in members.items():
        if name.startswith("_") or not isinstance(member, FunctionType | property | staticmethod | classmethod):
            continue
        function = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
        shown = name if isinstance(member, property) else _signature(name, function)
        yield f"**`.{' '.join(shown.split())}`**"
        yield from _described(inspect.getdoc(function) or "")


def _made_by_users(thing: type) -> bool:
    """Whether users make such objects themselves: what functions return is described by its attributes."""
    if dataclasses.is_dataclass(thing):
        fields = dataclasses.fields(thing)
        usual = all((each.default, each.default_factory) != (dataclasses.MISSING,) * 2 for each in fields)
        return usual or thing.__name__ in _MADE_BY_USERS
    return thing.__name__ in _MADE_BY_USERS or (
        not issubclass(thing, Exception) and "Args:" in (inspect.getdoc(thing) or "")
    )


def _signature(path: str, thing: Any) -> str:
    signature = inspect.signature(thing)
    parameters = [each for each in signature.parameters.values() if each.name not in ("self", "cls")]
    plain, kinds = [_parameter(each) for each in parameters], [each.kind for each in parameters]
    if inspect.Parameter.KEYWORD_ONLY in kinds and inspect.Parameter.VAR_POSITIONAL not in kinds:
        plain.insert(kinds.index(inspect.Parameter.KEYWORD_ONLY), "*")
    returns = signature.return_annotation
    end = "" if returns is inspect.Signature.empty or inspect.isclass(thing) else f" -> {_type(returns)}"
    line = f"{path}({', '.join(plain)}){end}"
    return line if len(line) <= _WIDTH else f"{path}(\n" + "".join(f"    {part},\n" for part in plain) + f"){end}"


def _parameter(parameter: inspect.Parameter) -> str:
    text, kind, default = parameter.name, parameter.kind, parameter.default
    text = f"*{text}" if kind is inspect.Parameter.VAR_POSITIONAL else text
    text = f"**{text}" if kind is inspect.Parameter.VAR_KEYWORD else text
    if parameter.annotation is not inspect.Parameter.empty:
        text += f": {_type(parameter.annotation)}"
    if default is inspect.Parameter.empty:
        return text
    if inspect.isfunction(default) or repr(default) == "<factory>":
        return f"{text} = ..."
    made_of: type[Any] = type(default)
    if _made_by_users(made_of) and default == made_of():
        return f"{text} = {made_of.__name__}()"
    return f"{text} = {getattr(default, 'name', None) or repr(default)}"


def _type(annotation: Any) -> str:
    """A type as one would write it."""
    text = annotation if isinstance(annotation, str) else inspect.formatannotation(annotation)
    if "NestedSequence" in text:  # what NumPy's name for all that becomes an array stands for
        return "ArrayLike | None" if "None" in text else "ArrayLike"
    text = re.sub(
        r"(?:jaxlib|jax|numpy|jaxfit|pathlib|collections\.abc|typing|jaxtyping)\.(?:_?\w+\.)*(?=\w)", "", text
    )
    return re.sub(r"\s+", " ", text)


def _described(docstring: str) -> Iterator[str]:
    """A docstring as Markdown: paragraphs, and its sections as lists."""
    blocks = re.split(rf"^({'|'.join(_SECTIONS)}):\n", docstring, flags=re.MULTILINE)
    if blocks[0].strip():
        yield _prose(blocks[0].strip())
    for title, body in zip(blocks[1::2], blocks[2::2], strict=True):
        body = textwrap.dedent(body).strip()
        if title in ("Returns", "Yields"):
            yield f"*{title}* {_prose(body)}"
        else:
            lines = [re.sub(r"\s*\n\s*", " ", item) for item in re.split(r"\n(?=\S)", body)]
            entries = [re.sub(r"^(\S+?):\s", r"`\1`: ", line) for line in lines]
            yield f"*{title}*\n\n" + "\n".join(f"- {_prose(entry)}" for entry in entries)


def _prose(text: str) -> str:
    """reStructuredText's marks as Markdown's."""
    text = re.sub(r":\w+:`([^`]+)`", r"`\1`", text).replace("``", "`")
    return re.sub(r"(?m)^>>> ", "    ", text)


if __name__ == "__main__":
    sys.exit(main())
