"""PyPI's `cyclonedds` as another decoder of CDR, where there is one for this Python: its types made of the definitions in a file, or of those that
`rosbags` has."""

import keyword
import sys
from dataclasses import dataclass, fields, is_dataclass

import numpy as np
from cyclonedds import idl
from cyclonedds.idl import types
from mcap.reader import make_reader
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_types_from_msg

BASES = {"bool": bool, "string": str, "byte": types.byte, "char": types.uint8, "octet": types.byte} | {
    name: getattr(types, name) for name in ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")}


class Types:
    """The structures of one file, by ROS's names."""

    def __init__(self, definitions=None):
        self.definitions, self.made = dict(definitions or {}), {}

    def add(self, schema):
        self.definitions |= get_types_from_msg(schema.data.decode(), schema.name)

    def of(self, name):
        if name not in self.made:
            # A word of Python's own is no name of a field there: it gets a line behind it, as rosbags does it.
            fields = {field + "_" * keyword.iskeyword(field): self.kind(node) for field, node in self.definitions[name][1]}
            class_name = name.replace("/", "_")
            # A structure of nothing has a byte in ROS 2; there is none in our files.
            assert fields, name
            made = idl.IdlMeta(class_name, (idl.IdlStruct,), {"__module__": __name__, "__annotations__": fields}, typename=class_name)
            setattr(sys.modules[__name__], class_name, made)
            self.made[name] = dataclass(made)
        return self.made[name]

    def kind(self, node):
        what, more = node
        if what == Nodetype.BASE:
            return BASES[more[0]]
        if what == Nodetype.NAME:
            return self.of(more)
        element, length = more
        return types.array[self.kind(element), length] if what == Nodetype.ARRAY else types.sequence[self.kind(element)]


def same(ours, other, where):
    """Every value of a message of Cyclone's against the same message as `rosbags` has it."""
    if is_dataclass(ours):
        for f in fields(ours):
            same(getattr(ours, f.name), getattr(other, f.name), f"{where}.{f.name}")
    elif isinstance(ours, str) or not hasattr(ours, "__len__"):
        assert ours == other or (ours != ours and other != other), f"{where}: {ours} to Cyclone DDS, {other} to rosbags"
    elif len(ours) and is_dataclass(ours[0]):
        assert len(ours) == len(other), f"{where}: {len(ours)} and {len(other)}"
        for number, (a, b) in enumerate(zip(ours, other)):
            same(a, b, f"{where}[{number}]")
    else:
        a, b = np.asarray(list(ours)), np.asarray(list(other))
        assert a.shape == b.shape and np.array_equal(a, b, equal_nan=a.dtype.kind == "f"), f"{where}: {a} to Cyclone DDS, {b} to rosbags"


def agrees(name, definitions, pairs):
    """The bytes of each pair are its message, as `rosbags` decoded it."""
    structure = Types(definitions).of(name)
    for payload, message in pairs:
        same(structure.deserialize(payload), message, name)


def messages(file):
    """(topic, message) of all of the file."""
    known = Types()
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            if schema.name not in known.definitions:
                known.add(schema)
            yield channel.topic, known.of(schema.name).deserialize(message.data)
