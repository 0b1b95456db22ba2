# SPDX-License-Identifier: MIT OR Apache-2.0
"""A memory behind a description in which its camera could be: what it has is there, bounds have room, values are valid."""
import re

import genicam.genapi as genapi

from description import BOOTSTRAP_END, REGISTERS, bound, is_number, tag

MATTERS = re.compile(
    "Trigger|Exposure|Shutter|Gain|PixelFormat|PixelCoding|PixelSize|Width|Height|Offset|Acquisition|UserSet|Gamma|LUT|"
    "Reverse|Binning|Decimation|Sequence|Chunk|Test|BlackLevel|Line|GevSCP|PayloadSize|Timestamp|Ptp|1588|Overlap|Sharp"
)
# What cameras deliver, where the description lets them.
DELIVERED = {
    "TriggerMode": "Off", "ExposureAuto": "Off", "GainAuto": "Off", "BlackLevelAuto": "Off", "AcquisitionMode": "Continuous",
    "ExposureMode": "Timed", "TestPattern": "Off", "TestImageSelector": "Off", "PixelFormat": "Mono8", "LineMode": "Input",
    "TriggerActivation": "RisingEdge", "SequencerMode": "Off", "GammaEnable": False, "LUTEnable": False, "LUTMode": "Off",
    "BinningHorizontal": 1, "BinningVertical": 1, "DecimationHorizontal": 1, "DecimationVertical": 1, "Gamma": 1.0,
    "ExposureTimeBaseAbs": 20.0, "OffsetX": 0, "OffsetY": 0, "ExposureTime": 5000.0, "ExposureTimeAbs": 5000.0, "AcquisitionFrameRate": 30.0,
    "AcquisitionFrameRateAbs": 30.0, "Gain": 0.0, "TriggerDelay": 0.0, "TriggerDelayAbs": 0.0, "TriggerDivider": 1,
    "UserSetSelector": "Default", "GainSelector": "All", "ChunkModeActive": False, "ReverseX": False, "ReverseY": False,
}
# Kinds of references by which a feature is there or not.
THERE = ("pIsImplemented", "pIsAvailable")
BOUNDS = ("pMin", "pMax", "pInc")


class Preparation:
    def __init__(self, camera, size):
        self.camera, self.size = camera, size
        self.all = list(walk(camera, "Root", set()))
        self.features = [name for name in self.all if MATTERS.search(name)]

    def run(self):
        for name in self.features:
            self.be_there(name)
        self.be_no_zero()
        for _ in range(2):
            for name in self.features:
                self.have_room(name)
            for name in self.features:
                self.be_valid(name)
        for _ in range(2):
            wanted = {"Width": self.size[0], "Height": self.size[1], **DELIVERED}
            for name, value in wanted.items():
                if name in self.camera.nodes and self.camera.get(name) != value:
                    self.deliver(name, value)
        for name in self.all:
            self.be_valid(name)
        self.behind_selectors()
        if "PayloadSize" in self.camera.nodes:
            self.seek(["PayloadSize"], ("pValue",), lambda: self.distance("PayloadSize", self.size[0] * self.size[1]),
                      [self.size[0] * self.size[1]])

    def behind_selectors(self):
        """What registers say of a trigger or a gain may lie behind its selector."""
        for selector in ("TriggerSelector", "GainSelector"):
            kind = selector.removesuffix("Selector")
            before = self.camera.get(selector)
            for entry in self.camera.entries(selector):
                if self.camera.put(selector, entry, by_maker=True):
                    for name in [name for name in self.features if name.startswith(kind) and name != selector]:
                        self.be_there(name)
                        self.be_valid(name)
                        if name in DELIVERED and self.camera.get(name) != DELIVERED[name]:
                            self.deliver(name, DELIVERED[name])
            if before is not None:
                self.camera.put(selector, before, by_maker=True)

    def deliver(self, name, value):
        if not self.camera.put(name, value, by_maker=True) and isinstance(value, float):
            self.camera.put(name, int(value), by_maker=True)

    def inquiries(self, names, kinds):
        """Registers that only the camera writes."""
        found = self.camera.registers(names, kinds)
        if kinds != THERE:
            found += [name for name in names if tag(self.camera.nodes[name]) in REGISTERS]
        # A bound is the camera's, whatever its register says.
        found = [name for name in found if self.camera.is_read_only(name) or re.search("Min|Max|Inc", name)]
        return list(dict.fromkeys(found))

    def be_there(self, name):
        """What the camera says that it has, it has."""
        chain = self.camera.chain(name)
        registers = self.inquiries(self.camera.below(name), THERE)
        for register in registers:
            node = self.camera.node(register, by_maker=True)
            try:
                if node.value == 0:
                    self.camera.put(register, node.max, by_maker=True)
            except (genapi.GenericException, AttributeError):
                continue
        if not self.is_there(name):
            bits = [0xFFFFFFFF, -1]
            self.seek(chain, THERE, lambda: 0 if self.is_there(name) else 1, bits)
            self.seek(chain, THERE, lambda: 0 if self.is_there(name) else 1, bits, only_read=False)

    def be_no_zero(self):
        """By steps and by what formulas divide by: no camera has zero there."""
        divisors = []
        for name in dict.fromkeys(below for feature in self.features for below in self.camera.below(feature)):
            node = self.camera.nodes[name]
            divisors += [ref for _, ref in self.camera.refs(name, ("pInc",))]
            formulas = " ".join(part.text or "" for part in node if tag(part).startswith("Formula"))
            by = re.findall(r"[/%]\s*\(?\s*([A-Za-z_]\w*)", formulas)
            divisors += [part.text.strip() for part in node if tag(part) == "pVariable" and part.get("Name") in by]
        for name in dict.fromkeys(divisors):
            if self.camera.get(name) or name not in self.camera.nodes:
                continue
            own = [name] if tag(self.camera.nodes[name]) in REGISTERS else []
            for register in own + self.camera.registers([name]):
                node = self.camera.node(register, by_maker=True)
                if is_number(node) and not self.is_fixed(node) and not self.camera.get(register):
                    self.camera.put(register, 1.0 if isinstance(node, genapi.IFloat) else 1, by_maker=True)

    def is_there(self, name):
        return self.camera.access(name) not in (genapi.EAccessMode.NI, genapi.EAccessMode.NA)

    def distance(self, name, wanted):
        value = self.camera.get(name)
        return 1e18 if value is None else abs(value - wanted)

    def usual(self, name):
        """What a number is on most cameras."""
        sizes = dict.fromkeys(("Width", "WidthMax", "SensorWidth"), self.size[0])
        sizes |= dict.fromkeys(("Height", "HeightMax", "SensorHeight"), self.size[1])
        if name in sizes:
            return sizes[name]
        if name == "GevSCPSPacketSize":
            return 9000
        return 1000.0 if re.match("(Exposure|Shutter)Time", name) else 0 if "Offset" in name else None

    def have_room(self, name):
        """A number has bounds between which it can be what is usual."""
        node = self.camera.node(name)
        if not self.is_there(name) or isinstance(node, genapi.IEnumeration) or not is_number(node):
            return
        usual = self.usual(name)

        def score():
            try:
                least, most = node.min, node.max
                if name in ("Width", "Height") and most != usual:
                    return 1 + abs(most - usual)
                step = bound(node, "inc", None) if not isinstance(least, float) else None
                bad = (step is not None and step <= 0) + (most < least)
                bad += most <= least and "Offset" not in name
                if usual is not None:
                    bad += least > usual or most < usual
                    bad += "Time" in name and (least > 100 or most < 20000)
                    bad += step is not None and (step <= 0 or usual % step != 0)
                if name.startswith("Gain"):
                    bad += least < 0 or most > 1000
                if name == "GevSCPSPacketSize":
                    bad += least > 576 or most < 9000
                return bad
            except genapi.GenericException:
                return 1e9

        self.seek(self.camera.chain(name), BOUNDS, score, [usual] if usual else [])
        if score():
            self.seek(self.camera.chain(name), None, score, [usual] if usual else [])

    def be_valid(self, name):
        """A value that is none becomes the first one that is."""
        camera = self.camera
        node = camera.node(name, by_maker=True)
        if not self.is_there(name):
            return
        try:
            if isinstance(node, genapi.IEnumeration):
                there = camera.entries(name)
                if there and camera.get(name) not in there:
                    wanted = [entry for entry in (DELIVERED.get(name), "Off") if entry in there] + there
                    camera.put(name, wanted[0], by_maker=True)
            elif is_number(node):
                value = camera.get(name)
                if value is not None and not node.min <= value <= node.max:
                    camera.put(name, node.min if value < node.min else node.max, by_maker=True)
        except genapi.GenericException:
            pass

    def seek(self, names, kinds, score, values, only_read=True):
        """Sets registers on which nodes rest, one after another, to what brings the score down; to 0 where that can be."""
        best = score()
        registers = self.inquiries(names, kinds) if only_read else self.camera.registers(names, kinds)
        usual = [0, 1, 2, 3, 4, 8, 16, 64, 100, 255, 1000, 1023, 4095, 10000, 65535, 100000, 1000000, 0x3FFFFFFF, 0x7FFFFFFF]
        for _ in range(2):
            for register in registers[:24]:
                if best == 0:
                    return
                node = self.camera.node(register, by_maker=True)
                kept = bound(node, "value", None) if is_number(node) else None
                if kept is None or self.camera.memory.fixed and self.is_fixed(node):
                    continue
                for value in values + usual:
                    value = float(value) if isinstance(kept, float) else int(value)
                    if not self.camera.put(register, value, by_maker=True):
                        continue
                    now = score()
                    if now < best:
                        best, kept = now, value
                    if best == 0:
                        break
                self.camera.put(register, kept, by_maker=True)

    def is_fixed(self, node):
        try:
            return node.address < BOOTSTRAP_END and node.address in self.camera.memory.fixed
        except (genapi.GenericException, AttributeError):
            return False


def walk(camera, category, seen):
    """All features, by the tree in which they are shown."""
    for _, name in camera.refs(category, ("pFeature",)):
        if name in seen or name not in camera.nodes:
            continue
        seen.add(name)
        if tag(camera.nodes[name]) == "Category":
            yield from walk(camera, name, seen)
        else:
            yield name
