"""Write docs/api.md: everything in ``jaxfit``, from its signatures and docstrings."""

import argparse
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jaxfit
from jaxfit.data.outputs import atomic_write

API = Path(__file__).resolve().parents[1] / "docs" / "api.md"
GROUPS = {
    "Models": ("load", "save", "bundled", "Model"),
    "Fitting": (
        "fit",
        "Fits",
        "fuse",
        "warm_up",
        "find_faces",
        "Found",
        "detect_faces",
        "read_image",
        "draw_landmarks",
        "draw_head",
    ),
    "Collections": ("fit_collection", "BatchFitter"),
    "Videos": ("track", "TrackedFrame", "TrackedFace", "Tracker", "OneEuro", "Video"),
    "The jitted function inside": ("crop_faces", "fit_crops", "fit_heads", "Heads", "fit_face"),
    "Labelled faces": (
        *("read_dataset", "Dataset", "FaceRecord"),
        *("convert_dataset", "lift_labels", "fill_labels", "share_labels", "Lifted"),
        "split_by_subject",
    ),
    "Training": (
        *(
            "train",
            "Options",
            "Trained",
            "choose_options",
            "Chosen",
            "Trial",
            "finetune",
            "Tuning",
            "Disturbance",
            "Finetuned",
        ),
        *("calibrate_boxes", "learn_confidence", "try_fits", "Trials"),
    ),
    "Evaluation": ("evaluate", "Evaluation", "start_boxes"),
    "Several processes": ("join_processes",),
    "3D shape models": ("load_head_model", "save_head_model", "bundled_head_models", "HeadModel"),
    "Export": ("export_model", "load_exported", "Exported"),
    "Errors": ("JaxfitError", "InputError", "ImageError", "DatasetError", "ModelError", "ProcessError"),
}
_ABOUT = """Made from the docstrings by `python scripts/build_api.py`. `N` counts faces, `L` landmarks, `H` and `W` the
rows and columns of a picture. Pixels have their centres at whole numbers, x to the right and y down; boxes are x, y,
width and height; angles are roll, pitch and yaw in degrees."""
_SECTIONS = ("Args", "Attributes", "Returns", "Yields", "Raises")
_WIDTH = 100  # of a signature, from which each parameter has a line


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.parse_args()
    with atomic_write(API, "w") as file:
        file.write(reference())
    return 0


def reference() -> str:
    """The whole page, as Markdown."""
    parts = [
        "# API reference",
        _ABOUT,
        "\n".join(
            f"- **{group}**: {', '.join(f'[`{name}`](#{_anchor(name)})' for name in names)}"
            for group, names in GROUPS.items()
        ),
    ]
    for group, names in GROUPS.items():
        parts.append(f"## {group}")
        for name in names:
            parts += _entry(name, getattr(jaxfit, name))
    return "\n\n".join(parts) + "\n"


def _anchor(name: str) -> str:
    return f"jaxfit{name}".lower()


def _entry(name: str, thing: Any) -> Iterator[str]:
    yield f"### jaxfit.{name}"
    shown = not inspect.isclass(thing) or _own_signature(thing)
    if shown:
        yield f"```python\n{_signature(f'jaxfit.{name}', thing)}\n```"
    yield from _described(inspect.getdoc(thing) or "")
    if inspect.isclass(thing):
        for member, what in vars(thing).items():
            if member.startswith("_") or not (
                inspect.isfunction(what) or isinstance(what, property | staticmethod | classmethod)
            ):
                continue
            function = what.fget if isinstance(what, property) else getattr(what, "__func__", what)
            head = f"{member}" if isinstance(what, property) else _signature(member, function)
            yield f"**`.{' '.join(head.split())}`**"
            yield from _described(inspect.getdoc(function) or "")


def _own_signature(thing: type) -> bool:
    """Whether users make such objects themselves: what functions return is described by its attributes."""
    return (not issubclass(thing, Exception) and "Args:" in (inspect.getdoc(thing) or "")) or thing in (
        jaxfit.Options,
        jaxfit.OneEuro,
    )


def _signature(name: str, thing: Any) -> str:
    signature = inspect.signature(thing)
    plain = [_told(parameter) for parameter in signature.parameters.values() if parameter.name != "self"]
    kinds = [parameter.kind for parameter in signature.parameters.values() if parameter.name != "self"]
    if inspect.Parameter.KEYWORD_ONLY in kinds and inspect.Parameter.VAR_POSITIONAL not in kinds:
        plain.insert(kinds.index(inspect.Parameter.KEYWORD_ONLY), "*")
    returns = signature.return_annotation
    end = "" if returns is inspect.Signature.empty or inspect.isclass(thing) else f" -> {_type(returns)}"
    line = f"{name}({', '.join(plain)}){end}"
    return line if len(line) <= _WIDTH else f"{name}(\n" + "".join(f"    {part},\n" for part in plain) + f"){end}"


def _told(parameter: inspect.Parameter) -> str:
    stars = {inspect.Parameter.VAR_POSITIONAL: "*", inspect.Parameter.VAR_KEYWORD: "**"}.get(parameter.kind, "")
    text = stars + parameter.name
    if parameter.annotation is not inspect.Parameter.empty:
        text += f": {_type(parameter.annotation)}"
    if parameter.default is not inspect.Parameter.empty:
        default = parameter.default
        shown = "..." if inspect.isfunction(default) else getattr(default, "name", None) or repr(default)
        text += f" = {shown}"
    return text


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
        items = re.split(r"\n(?=\S)", textwrap.dedent(body).strip("\n"))
        listed, rest = items, []
        lines = [re.sub(r"\s*\n\s*", " ", item.strip()) for item in listed]
        if title in ("Returns", "Yields"):
            yield f"*{title}* {_prose(textwrap.dedent(body).strip())}"
        else:
            entries = [re.sub(r"^(\S+?):\s", r"`\1`: ", line) for line in lines]
            yield f"*{title}*\n\n" + "\n".join(f"- {_prose(entry)}" for entry in entries)
        for paragraph in rest:
            yield _prose(paragraph)


def _prose(text: str) -> str:
    """reStructuredText's marks as Markdown's."""
    text = re.sub(r":\w+:`([^`]+)`", r"`\1`", text).replace("``", "`")
    return re.sub(r"(?m)^>>> ", "    ", text)


if __name__ == "__main__":
    sys.exit(main())
