# SPDX-License-Identifier: MIT OR Apache-2.0
"""What a camera's registers really say after it was set up, and what of that is not as it was asked for."""
from math import isclose

from description import bound

FRAME = ("FrameStart", "ExposureStart", "FrameBurstStart", "FrameTrigger", "ImageStart", "Frame", "Exposure")
OFF = (None, False, 0, "Off", "None", "False", "Disabled", "Manual", "Linear", "X1", "1", "Basic")
ON = (True, 1, "On", "True", "Enabled", "Enable")
# Each must be off: what changes pixels, times or frames without a word.
MUST_BE_OFF = (
    "ExposureAuto", "GainAuto", "BlackLevelAuto", "GammaEnable", "GammaEnabled", "LUTEnable", "ReverseX",
    "ReverseY", "SequencerMode", "SequenceEnable", "SequencerEnable", "SeqEnable", "BoSequencerEnable", "ChunkModeActive",
    "AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled", "TestPattern", "TestImageSelector", "TestImage",
    "TriggerDelayEnabled",
)
# Each must be one: so many pixels become one.
MUST_BE_ONE = ("BinningHorizontal", "BinningVertical", "DecimationHorizontal", "DecimationVertical")
EXPOSURES = ("ExposureTime", "ExposureTimeAbs", "ExposureTimeUs", "IntegrationTime", "ShutterTimeAbs", "ShutterTime")
TO_MICROSECONDS = {"s": 1e6, "ms": 1e3, "us": 1.0, "\u00b5s": 1.0, "ns": 1e-3}


def plain(text):
    return "".join(c for c in str(text).lower() if c.isalnum())


def behind(camera, selector, read):
    """What `read` gives behind each entry of a selector; the selector is left as it was."""
    entries = camera.entries(selector) if camera.is_writable(selector) else []
    if not entries:
        return {camera.get(selector): read()}
    before, found = camera.get(selector), {}
    for entry in entries:
        if camera.put(selector, entry):
            found[entry] = read()
    camera.put(selector, before)
    return found


def trigger(camera):
    names = ("TriggerMode", "TriggerSource", "TriggerActivation", "TriggerPolarity", "TriggerOverlap", "TriggerDelay",
             "TriggerDelayAbs", "TriggerDivider")
    places = []

    def one():
        places.append(places_of(camera, "TriggerMode"))
        return {name: camera.get(name) for name in names}

    selected = camera.get("TriggerSelector")
    of = behind(camera, "TriggerSelector", one)
    if len(places) > 1 and all(place == places[0] for place in places):
        # One mode for all: the trigger is the one that is selected.
        of = {selected: of[selected]} if selected in of else of
    return {str(entry): values for entry, values in of.items() if values["TriggerMode"] in ON}


def places_of(camera, name):
    """The places of memory on which a feature's value rests as the camera is set now."""
    camera.forget()
    camera.memory.places = set()
    camera.get(name)
    places, camera.memory.places = camera.memory.places, None
    return places


def exposure(camera):
    """In microseconds; None where no feature says it in a unit of time."""
    for name in EXPOSURES:
        value = camera.get(name)
        if value is not None:
            unit = str(bound(camera.node(name), "unit", "") or "us").strip().lower()
            return value * TO_MICROSECONDS.get(unit, 1.0)
    raw, base = camera.get("ExposureTimeRaw"), camera.get("ExposureTimeBaseAbs")
    return raw * (base or 1.0) if raw is not None else None


def gains(camera):
    def one():
        for name in ("Gain", "GainAbs", "GainRaw"):
            value = camera.get(name)
            if value is not None:
                least = bound(camera.node(name), "min", 0)
                return [name, value, least]
        return None

    return behind(camera, "GainSelector", one)


def judge(camera, asked):
    """`found`, and `wrong`: each a sentence."""
    wrong = []
    say = lambda what, found, expected: wrong.append(f"{what} is {found}, asked for {expected}")
    # What is left to the camera's own settings is as those make it.
    left = asked.get("left", ())
    on = trigger(camera) if "trigger_line" not in left else {}
    found = {"triggers": on, "exposure_us": exposure(camera), "gains": gains(camera)}
    if len(on) != 1 and "trigger_line" not in left:
        say("the trigger that is on", ", ".join(on) or "none", "one that starts a frame")
    for entry, values in on.items():
        # Before SFNC there was one trigger alone, and that one took a frame.
        alone = camera.entries("TriggerSelector") == [entry] == ["AcquisitionStart"]
        known = entry == "None" or alone or plain(entry) in map(plain, FRAME)
        if not known:
            say("the trigger that is on", entry, "one that starts a frame")
        if values["TriggerSource"] is not None and values["TriggerSource"] != asked["line"]:
            say("TriggerSource", values["TriggerSource"], asked["line"])
        edge = values["TriggerActivation"] or values["TriggerPolarity"]
        if edge is not None and edge != "None" and "trigger_edge" not in left and plain(edge) not in asked["edges"]:
            say("the edge", edge, asked["edges"][0])
        if plain(values["TriggerOverlap"] or "") in ("off", "nonoverlap"):
            overlaps = camera.entries("TriggerOverlap")
            if any(plain(o) in ("readout", "previousframe", "on") for o in overlaps):
                say("TriggerOverlap", values["TriggerOverlap"], "one during the readout")
        for delay in ("TriggerDelay", "TriggerDelayAbs"):
            least = bound(camera.node(delay), "min", 0) if values[delay] is not None else 0
            if values[delay] is not None and values[delay] > max(least, 0) + 1e-6:
                say(delay, values[delay], least)
        if values["TriggerDivider"] not in (None, 1):
            say("TriggerDivider", values["TriggerDivider"], 1)
    microseconds = found["exposure_us"] if "exposure_us" not in left else None
    if microseconds is not None and not isclose(microseconds, asked["exposure_us"], abs_tol=asked["tolerance_us"]):
        say("the exposure", f"{microseconds} us", f"{asked['exposure_us']} us")
    if "exposure_us" not in left and camera.get("ExposureMode") not in (None, "Timed", "Manual", "Off"):
        say("ExposureMode", camera.get("ExposureMode"), "Timed")
    for entry, gain in found["gains"].items():
        # A gain in dB that can be 0 is 0, any other the least.
        if gain and not isclose(gain[1], max(gain[2], 0.0) if gain[0] != "GainRaw" else gain[2], abs_tol=0.05):
            say(f"{gain[0]} of {entry}", gain[1], f"the least, {gain[2]}")
    for name in MUST_BE_OFF:
        if name in camera.nodes and camera.get(name) not in OFF:
            # A switch that nothing can turn off is no setting.
            say(name, camera.get(name), "off")
    for name in MUST_BE_ONE:
        value = camera.get(name)
        if value is not None and "".join(c for c in str(value) if c.isdigit()).lstrip("0") not in ("1", "11", "") :
            say(name, value, 1)
    gamma = camera.get("Gamma")
    switches = [camera.get(name) for name in ("GammaEnable", "GammaEnabled")]
    if isinstance(gamma, float) and not isclose(gamma, 1.0, abs_tol=0.01) and all(s not in (False, 0) for s in switches):
        say("Gamma", gamma, 1.0)
    mode, pixels = camera.get("AcquisitionMode"), camera.get("PixelFormat")
    if mode is not None and plain(mode) != "continuous":
        say("AcquisitionMode", mode, "Continuous")
    # Grey that is deeper than 8 bits is taken where there is no other.
    deeper = "Mono8" not in camera.entries("PixelFormat") and str(pixels).startswith("Mono1")
    if "pixel" not in left and pixels is not None and plain(pixels) != "mono8" and not deeper:
        say("PixelFormat", pixels, "Mono8")
    for name, expected in (("Width", asked["size"][0]), ("Height", asked["size"][1])):
        if camera.get(name) is not None and camera.get(name) != expected:
            say(name, camera.get(name), expected)
    packet = camera.get("GevSCPSPacketSize") if asked["packet"] else None
    if packet is not None and packet not in (asked["packet"], taken(camera.node("GevSCPSPacketSize"), asked["packet"])):
        say("GevSCPSPacketSize", packet, asked["packet"])
    if "trigger_line" not in left:
        line(camera, asked["line"], wrong)
    for name in ("PixelFormat", "Width", "Height", "OffsetX", "OffsetY", "GevSCPSPacketSize", "UserSetSelector", "AcquisitionMode"):
        found[name] = camera.get(name)
    return {"found": found, "wrong": wrong}


def taken(node, wanted):
    """The largest value that a number takes and that is not above this one."""
    least, most, step = bound(node, "min", 0), bound(node, "max", wanted), bound(node, "inc", 1) or 1
    return wanted if most < least else least + (min(wanted, most) - least) // step * step


def line(camera, name, wrong):
    """The line itself: an input that nothing turns round."""
    lines = behind(camera, "LineSelector", lambda: (camera.get("LineMode"), camera.get("LineInverter")))
    mode, inverted = lines.get(name, (None, None))
    if mode is not None and plain(mode) not in ("input", "trigger"):
        wrong.append(f"LineMode of {name} is {mode}, asked for Input")
    if inverted in ON:
        wrong.append(f"LineInverter of {name} is {inverted}, asked for False")
