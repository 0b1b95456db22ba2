# SPDX-License-Identifier: MIT OR Apache-2.0
"""What a last user may have left, in every way that a description has."""
from description import bound

# (name, settings): of alternatives in other spellings all are tried; (selector, entry) before a setting selects.
WAYS = (
    ("automatic functions", [("ExposureAuto", "Continuous"), ("GainAuto", "Continuous"), ("BlackLevelAuto", "Continuous")]),
    ("curves", [("GammaEnable", True), ("GammaEnabled", True), ("Gamma", 0.5), ("LUTEnable", True), ("LUTMode", "Active")]),
    ("mirrored", [("ReverseX", True), ("ReverseY", True)]),
    ("binned", [("BinningHorizontal", 2), ("BinningVertical", 2), ("BinningVertical", "X2"), ("BinningHorizontal", "X2")]),
    ("decimated", [("DecimationHorizontal", 2), ("DecimationVertical", 2)]),
    ("a part of the sensor", [("Width", "least"), ("Height", "least"), ("OffsetX", "some"), ("OffsetY", "some")]),
    ("another pixel format", [("PixelFormat", "other")]),
    ("one frame", [("AcquisitionMode", "SingleFrame")]),
    ("exposed by the trigger", [("ExposureMode", "TriggerWidth")]),
    ("paced", [("AcquisitionFrameRateEnable", True), ("AcquisitionFrameRateEnabled", True), ("AcquisitionFrameRate", 3.0)]),
    ("chunks", [("ChunkModeActive", True)]),
    ("a test image", [("TestPattern", "other"), ("TestImageSelector", "other")]),
    ("a sequence", [("SequencerMode", "On"), ("SequenceEnable", True), ("SequencerEnable", True), ("BoSequencerEnable", "On")]),
    ("a long exposure and much gain", [("ExposureTime", 15000.0), ("ExposureTimeAbs", 15000.0), ("Gain", "most"), ("GainRaw", "most")]),
    ("another source", [("TriggerSource", "other")]),
    ("another edge", [("TriggerActivation", "FallingEdge"), ("TriggerActivation", "LevelHigh")]),
    ("a software trigger", [("TriggerMode", "On"), ("TriggerSource", "Software")]),
    ("other triggers", [("TriggerSelector", "each"), ("TriggerMode", "On")]),
    ("no overlap", [("TriggerOverlap", "Off")]),
    ("a late trigger", [("TriggerDelay", 9000.0), ("TriggerDelayAbs", 9000.0)]),
    ("every second trigger", [("TriggerDivider", 2)]),
    ("lines turned round", [("LineSelector", "each"), ("LineMode", "Output"), ("LineInverter", True)]),
    ("another user set", [("UserSetSelector", "other"), ("UserSetDefault", "other"), ("UserSetDefaultSelector", "other")]),
)


def leave(camera, settings):
    """Makes the settings that the camera takes; says whether there was one."""
    if settings[0][1] == "each":
        selector = settings[0][0]
        before, any_left = camera.get(selector), False
        for entry in camera.entries(selector):
            if camera.put(selector, entry, by_maker=True):
                any_left = leave(camera, settings[1:]) or any_left
        camera.put(selector, before, by_maker=True)
        return any_left
    # One after another, whatever the ones before came to.
    return any([put(camera, name, value) for name, value in settings])


def put(camera, name, value):
    if name not in camera.nodes or not camera.is_writable(name):
        return False
    before, node = camera.get(name), camera.node(name)
    entries = camera.entries(name)
    if value == "other":
        value = next((entry for entry in reversed(entries) if entry not in (before, "Software")), None)
    elif value in ("least", "most", "some"):
        least, most = bound(node, "min", None), bound(node, "max", None)
        step = bound(node, "inc", None) or 1
        value = {"least": least, "most": most, "some": None if most is None else min(most, (least or 0) + 8 * step)}[value]
    if value is None:
        return False
    return camera.put(name, value, by_maker=True) and camera.get(name) != before
