"""Pytrees of arrays as safetensors files: weights, optimiser states, datasets. Nothing is ever unpickled."""

from __future__ import annotations

import dataclasses
import json
import os
import typing
from collections.abc import Iterable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load_file, save_file

from avatarjax.io import atomic

PyTree = typing.Any


def _key_string(path: tuple) -> str:
    return jax.tree_util.keystr(path, simple=True, separator="/")


def save_tree(path: str | os.PathLike, tree: PyTree, **metadata: typing.Any) -> None:
    """Write the array leaves of a pytree under their tree paths, and JSON `metadata` in the header, atomically.

    Typed PRNG keys are stored as their key data.
    """
    arrays = {}
    for key, leaf in jax.tree_util.tree_leaves_with_path(tree):
        leaf = jax.random.key_data(leaf) if _is_key(leaf) else leaf
        arrays[_key_string(key)] = np.asarray(leaf, order="C")
    with atomic.replacing(path) as temporary:
        save_file(arrays, str(temporary), metadata={"avatarjax": json.dumps(metadata)})


def load_arrays(
    path: str | os.PathLike, names: Iterable[str] | None = None
) -> tuple[dict[str, np.ndarray], dict[str, typing.Any]]:
    """All arrays of a file by name, or only those in `names`, and its metadata.

    Raises ValueError that names a missing or corrupt file, or one that lacks an array.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path} does not exist")
    try:
        if names is None:
            arrays = load_file(str(path))
        else:
            with safe_open(str(path), framework="numpy") as file:
                arrays = {name: file.get_tensor(name) for name in names}
        with path.open("rb") as f:
            header = json.loads(f.read(int.from_bytes(f.read(8), "little")))
    except (SafetensorError, ValueError) as error:
        raise ValueError(f"{path} is not a whole safetensors file ({error}); delete it and build it again") from error
    return arrays, json.loads(header.get("__metadata__", {}).get("avatarjax", "{}"))


def load_tree(path: str | os.PathLike, template: PyTree) -> tuple[PyTree, dict[str, typing.Any]]:
    """A pytree of the structure, shapes and dtypes of `template` (arrays or `jax.ShapeDtypeStruct`s), and the metadata.

    Raises ValueError that names the first array which is missing or of another shape: the file then belongs to another
    configuration.
    """
    arrays, metadata = load_arrays(path)
    leaves = []
    paths, treedef = jax.tree_util.tree_flatten_with_path(template)
    for key, leaf in paths:
        name = _key_string(key)
        shape = jax.eval_shape(jax.random.key_data, leaf).shape if _is_key(leaf) else np.shape(leaf)
        if name not in arrays or arrays[name].shape != shape:
            found = arrays[name].shape if name in arrays else "nothing"
            raise ValueError(f"{path} does not fit this configuration: {name} should be {shape}, the file has {found}")
        value = jnp.asarray(arrays[name])
        leaves.append(jax.random.wrap_key_data(value) if _is_key(leaf) else value.astype(leaf.dtype))
    return jax.tree_util.tree_unflatten(treedef, leaves), metadata


def nest(arrays: dict[str, typing.Any]) -> dict[str | int, typing.Any]:
    """Arrays by path as nested dicts; path parts that are whole numbers become integer keys, as in Flax lists."""
    tree: dict[str | int, typing.Any] = {}
    for name, value in arrays.items():
        *parents, last = (int(part) if part.isdigit() else part for part in name.split("/"))
        node = tree
        for part in parents:
            node = node.setdefault(part, {})
        node[last] = value
    return tree


def from_dict(cls: type, values: dict[str, typing.Any]) -> typing.Any:
    """A (nested) config dataclass from the JSON form of `dataclasses.asdict`."""
    hints = typing.get_type_hints(cls)
    fields = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(hints[name]):
            value = from_dict(hints[name], value)
        fields[name] = _tuples(value)
    return cls(**fields)


def _tuples(value: typing.Any) -> typing.Any:
    """Lists, which JSON makes of tuples, as tuples again."""
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _is_key(leaf: typing.Any) -> bool:
    return hasattr(leaf, "dtype") and jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
