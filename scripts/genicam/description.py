# SPDX-License-Identifier: MIT OR Apache-2.0
"""A published description over a memory of words, opened with EMVA's own GenApi (PyPI: genicam)."""
import re
import xml.etree.ElementTree as ElementTree
import zipfile

import genicam.genapi as genapi

BOOTSTRAP_END = 0xA000
BESIDE = {"pSelected", "pPort", "pInvalidator", "pIsImplemented", "pIsAvailable", "pIsLocked", "pFeature", "pAlias"}
REGISTERS = {"IntReg", "MaskedIntReg", "FloatReg", "StringReg", "Register", "StructEntry"}


def read(path):
    """The text of a description, from XML or zipped XML, without what somebody put before it."""
    data = open(path, "rb").read()
    if data.startswith(b"PK"):
        with zipfile.ZipFile(path) as archive:
            data = archive.read(archive.namelist()[0])
    data = data[min(at for at in (data.find(b"<?"), data.find(b"<R")) if at >= 0):]
    return data.decode("utf-8", "replace")


class Memory(genapi.AbstractPort):
    """Words by address; behind selectors there is one for each of their values, as the simulator has it."""

    def __init__(self):
        super().__init__()
        self.words, self.banks, self.wrote, self.fixed = {}, {}, [], set()
        # The places that were read, while somebody wants to know.
        self.places = None

    def place(self, at):
        return (at, tuple(self.word(by) for by in self.banks.get(at, ())))

    def word(self, at):
        place = self.place(at)
        if self.places is not None:
            self.places.add(place)
        found = self.words.get(place)
        return self.words.get((at, ()), 0) if found is None else found

    def read(self, address, length):
        start = address & 0xFFFFFFFC
        end = (address & 0xFFFFFFFF) + length
        data = b"".join(self.word(at).to_bytes(4, "big") for at in range(start, end, 4))
        return data[address - start if address < 1 << 32 else 0:][:length]

    def write(self, address, value):
        address &= 0xFFFFFFFF
        for offset, byte in enumerate(bytes(value)):
            at, shift = (address + offset) & ~3, 8 * (3 - (address + offset) % 4)
            self.wrote.append(at)
            if at not in self.fixed:
                self.words[self.place(at)] = self.word(at) & ~(255 << shift) & 0xFFFFFFFF | byte << shift

    def get_access_mode(self):
        return genapi.EAccessMode.RW

    def is_open(self):
        return True


class Description:
    """Its text as a graph of nodes, and two maps of nodes over one memory: as it is, and as its maker has it, who can write all."""

    def __init__(self, path):
        text = read(path)
        self.root = ElementTree.fromstring(text.encode())
        # An entry is no node of its own: `Width` is one of a selector of chunks, too.
        named = (node for node in self.root.iter() if node.get("Name") and tag(node) != "EnumEntry")
        self.nodes = {node.get("Name"): node for node in named}
        for struct in [node for node in self.root.iter() if tag(node) == "StructReg"]:
            # What a structure says is said of its entries.
            common = [part for part in struct if tag(part) != "StructEntry"]
            for entry in [part for part in struct if tag(part) == "StructEntry"]:
                entry.extend(part for part in common if tag(part) not in [tag(own) for own in entry])
        self.memory = Memory()
        self.map = self.open(text)
        # The maker writes what others only read, whenever he likes.
        text = re.sub(r"<((?:Imposed)?AccessMode)>\s*(RO|WO)\s*<", r"<\1>RW<", text)
        text = re.sub(r"<(\w*:?)pIsLocked>[^<]*</\1pIsLocked>", "", text)
        self.maker = self.open(text)

    def open(self, text):
        nodes = genapi.NodeMap()
        nodes.load_xml_from_string(text)
        ports = [name for name, node in self.nodes.items() if tag(node) == "Port"]
        for port in ports:
            try:
                nodes.connect(self.memory, port)
            except genapi.GenericException:
                pass  # That of chunks, for instance.
        return nodes

    def forget(self):
        """What the maps remember of the memory."""
        self.map._invalidate_nodes()
        self.maker._invalidate_nodes()

    def node(self, name, by_maker=False):
        nodes = self.maker if by_maker else self.map
        return nodes.get_node(name) if name in self.nodes and nodes.has_node(name) else None

    def access(self, name):
        node = self.node(name)
        try:
            return genapi.EAccessMode.NI if node is None else genapi.EAccessMode(node.get_access_mode())
        except genapi.GenericException:
            return genapi.EAccessMode.NA

    def is_readable(self, name):
        return self.access(name) in (genapi.EAccessMode.RO, genapi.EAccessMode.RW)

    def is_writable(self, name):
        return self.access(name) in (genapi.EAccessMode.WO, genapi.EAccessMode.RW)

    def get(self, name):
        """A value in the words of the description; None where it cannot be read."""
        try:
            if not self.is_readable(name):
                return None
            node = self.node(name)
            if isinstance(node, genapi.IEnumeration):
                return node.to_string()
            return node.value
        except (genapi.GenericException, AttributeError):
            return None

    def put(self, name, value, by_maker=False):
        """Sets a value; says whether that was possible. What a selector selects may be kept in a map instead of the memory:
        it is set in both."""
        if name.endswith("Selector"):
            self.put_one(name, value, not by_maker)
        return self.put_one(name, value, by_maker)

    def put_one(self, name, value, by_maker):
        node = self.node(name, by_maker)
        try:
            if isinstance(node, genapi.IEnumeration):
                node.from_string(str(value))
            elif not self.has_steps(name, by_maker):
                return False  # GenApi divides by what is zero.
            else:
                node.set_value(value)
        except (genapi.GenericException, AttributeError, TypeError, OverflowError):
            return False
        self.forget()
        return True

    def has_steps(self, name, by_maker):
        nodes = [self.node(other, by_maker) for other in self.chain(name)]
        return all(bound(node, "inc", 1) > 0 for node in nodes if isinstance(node, genapi.IInteger))

    def chain(self, name):
        """A feature and the nodes that its value passes through."""
        names = [name]
        for known in names:
            names += [ref for _, ref in self.refs(known, ("pValue",)) if ref not in names]
        return names

    def below(self, name):
        """A feature and all nodes on which its value and its bounds rest."""
        names = [name]
        for known in names:
            found = [ref for kind, ref in self.refs(known) if kind not in BESIDE and ref not in names and ref in self.nodes]
            names += dict.fromkeys(found)
        return names

    def entries(self, name):
        """The entries of an enumeration that are there now."""
        node = self.node(name)
        try:
            return [e.symbolic for e in getattr(node, "entries", []) if e.get_access_mode() in (3, 4, 2)]
        except genapi.GenericException:
            return []

    def refs(self, name, kinds=None):
        """Names of the nodes that a node names, by the elements that name them."""
        node = self.nodes.get(name)
        for part in node.iter() if node is not None else ():
            if part is node or part.text is None or not tag(part).startswith("p"):
                continue
            if kinds is None or tag(part) in kinds:
                yield tag(part), part.text.strip()

    def registers(self, names, kinds=None):
        """The registers on which nodes rest, directly or not; `kinds` for the first step alone."""
        seen, found, todo = set(), [], [ref for name in names for _, ref in self.refs(name, kinds)]
        while todo:
            name = todo.pop()
            if name in seen or name not in self.nodes:
                continue
            seen.add(name)
            if tag(self.nodes[name]) in REGISTERS:
                found.append(name)
            todo += [ref for kind, ref in self.refs(name) if kind not in ("pSelected", "pPort", "pInvalidator")]
        return found

    def is_read_only(self, name):
        mode = [part.text for part in self.nodes[name] if tag(part) in ("AccessMode", "ImposedAccessMode")]
        return "RO" in mode


def tag(node):
    return node.tag.split("}")[-1]


def is_number(node):
    return isinstance(node, (genapi.IInteger, genapi.IFloat))


def bound(node, which, otherwise):
    """A bound, a step or a unit; `otherwise` where it cannot be had as the camera is."""
    try:
        return getattr(node, which, otherwise)
    except genapi.GenericException:
        return otherwise


def kind(camera):
    """The network that it is made for, as far as its names say."""
    text = " ".join(camera.nodes)
    if "Gev" in text or "StreamBytesPerSecond" in text:
        return "GigE"
    is_usb = any(name in text for name in ("U3V", "USB", "DeviceLinkThroughputLimit"))
    return "USB3" if is_usb and "Cxp" not in text else "other"
