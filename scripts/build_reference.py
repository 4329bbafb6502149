"""Write the reference of the documentation site: the Python API, a page a namespace, and the command line.

The pages are made whenever the site is built, from signatures, docstrings and the command's own parsers. Git ignores
them.
"""

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
from jaxfit.cli.main import parser as command_parser
from jaxfit.data.outputs import atomic_write
from jaxfit.schemes import Scheme

REFERENCE = Path(__file__).resolve().parents[1] / "docs" / "reference"
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
_API = """# Python API

`jaxfit` itself has the names that most people need; each namespace has the rest of one subject. These pages are made
from the docstrings when the site is built; `help(jaxfit.fit)` shows the same text in Python.

`N` counts faces, `L` landmarks, `H` and `W` the rows and columns of a picture. Pixels have their centres at whole
numbers, x to the right and y down. Boxes are x, y, width and height. Angles are roll, pitch and yaw in degrees."""
_COMMANDS = """# Commands

Each command with its arguments and options, as `jaxfit COMMAND --help` prints them. The
[guides](../guides/fit-a-folder.md) show what to do with them;
[troubleshooting](../guides/troubleshooting.md#exit-codes) lists the exit codes."""
_SECTIONS = ("Args", "Attributes", "Returns", "Yields", "Raises")
_WIDTH = 100  # of a signature, from which each parameter has a line
_MADE_BY_USERS = ("FolderRun", "Pipeline", "Source")  # beside classes whose attributes all have defaults


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    write_reference(REFERENCE)
    return 0


def write_reference(folder: Path) -> None:
    """Write all pages into a folder. Those that have not changed are left alone: Sphinx need not read them again."""
    for name, text in {**api_pages(), "commands.md": commands_page()}.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            with atomic_write(path, "w") as file:
                file.write(text)


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


def api_pages() -> dict[str, str]:
    """The pages of the Python API as Markdown, by their paths: a list of all names, and a page for each namespace.

    A thing that several namespaces have is described where it comes first.
    """
    places: dict[int, str] = {}
    lists, toctree = [], ["```{toctree}", ":hidden:", ""]
    pages = {}
    for path, module in modules().items():
        names = public_names(module)
        new = [name for name in names if id(getattr(module, name)) not in places]
        places |= {id(getattr(module, name)): path for name in new}
        links = [f"[`{name}`]({places[id(getattr(module, name))]}.md#{_anchor(name)})" for name in names]
        lists.append(f"**[{path}]({path}.md)**: {', '.join(links)}")
        toctree.append(path)
        entries = [part for name in new for part in _entry(path, name, getattr(module, name))]
        contents = f"Names: {', '.join(links)}."
        about = _prose(inspect.getdoc(module) or "")
        pages[f"api/{path}.md"] = "\n\n".join([f"# {path}", about, contents, *entries]) + "\n"
    pages["api/index.md"] = "\n\n".join([_API, *lists, "\n".join([*toctree, "```"])]) + "\n"
    return pages


def commands_page() -> str:
    """All commands as Markdown: what each is for, how it is called, and its options by group."""
    return "\n\n".join([_COMMANDS, *_commands(command_parser())]) + "\n"


def _commands(parser: argparse.ArgumentParser) -> Iterator[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _command(command)
                yield from _commands(command)


def _command(parser: argparse.ArgumentParser) -> Iterator[str]:
    yield f"## {parser.prog}"
    if parser.description:
        yield _plain(" ".join(parser.description.split()))
    formatter = argparse.HelpFormatter(parser.prog, width=_WIDTH)
    formatter.add_usage(parser.usage, parser._actions, parser._mutually_exclusive_groups, prefix="")
    yield f"```text\n{formatter.format_help().strip()}\n```"
    helper = parser._get_formatter()
    for group in parser._action_groups:
        shown = [
            each for each in group._group_actions if each.help not in (None, argparse.SUPPRESS) and each.dest != "help"
        ]
        if not shown:
            continue
        yield f"*{(group.title or '').capitalize()}*" + (f": {_plain(group.description)}" if group.description else "")
        lines = (f"- `{helper._format_action_invocation(each)}`: {_plain(helper._expand_help(each))}" for each in shown)
        yield "\n".join(lines)


def _plain(text: str) -> str:
    """Text that holds no marks of Markdown or MyST."""
    return re.sub(r"([\\*<>$\[\]`{}])", r"\\\1", " ".join(text.split()))


def description(name: str, thing: Any) -> str:
    """What a public thing is for: its docstring, or what stands here for a constant; empty if nothing says it."""
    if inspect.isclass(thing) or inspect.isroutine(thing):
        return inspect.getdoc(thing) or ""
    if isinstance(thing, Scheme):
        return f"The landmark scheme `{thing.name}` of {thing.count} landmarks."
    return f"{_CONSTANTS[name]}: {', '.join(f'`{each}`' for each in thing)}." if name in _CONSTANTS else ""


def _anchor(name: str) -> str:
    return name.lower()


def _entry(path: str, name: str, thing: Any) -> Iterator[str]:
    yield f"## {name}"
    if inspect.isroutine(thing) or (inspect.isclass(thing) and _made_by_users(thing)):
        yield f"```python\n{_signature(f'{path}.{name}', thing)}\n```"
    yield from _described(description(name, thing))
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
