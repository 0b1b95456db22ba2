# SPDX-License-Identifier: MIT OR Apache-2.0
"""What the registers behind a description do by themselves: commands are done, selectors select."""
import genicam.genapi as genapi

from description import is_number, tag

DOES = {"AcquisitionStart": "start", "AcquisitionStop": "stop", "UserSetLoad": "load"}


def of(camera, features):
    return {"commands": commands(camera), "banks": banks(camera, features)}


def kept(camera, work):
    """What `work` writes where, with the memory left as it was."""
    memory = camera.memory
    words, memory.wrote = dict(memory.words), []
    try:
        work()
        return {at: memory.word(at) for at in dict.fromkeys(memory.wrote)}
    except (genapi.GenericException, AttributeError):
        return {}
    finally:
        memory.words = words
        camera.forget()


def commands(camera):
    """Every command that is one word, by the bits that it writes whatever the others are."""
    found = []
    for name, node in camera.nodes.items():
        if tag(node) != "Command":
            continue

        def execute(fill):
            camera.memory.words.update(fill)
            camera.forget()
            camera.node(name, by_maker=True).execute()

        first = kept(camera, lambda: execute({}))
        if len(first) != 1:
            continue
        (at, word), = first.items()
        among_ones = kept(camera, lambda: execute({(at, ()): 0xFFFFFFFF})).get(at)
        among_zeros = kept(camera, lambda: execute({(at, ()): 0})).get(at)
        if among_ones is None or among_zeros is None:
            continue
        mask = ~(among_ones ^ among_zeros) & 0xFFFFFFFF
        if mask:
            found.append({"address": at, "mask": mask, "value": word & mask, "does": DOES.get(name, "nothing")})
    # What is written with zero cannot be told from a write of something else, unless another command has the same bits.
    bits = [(command["address"], command["mask"]) for command in found]

    def is_seen(command):
        pair = bits.count((command["address"], command["mask"])) > 1
        return command["value"] or command["mask"] == 0xFFFFFFFF or pair

    return [command for command in found if is_seen(command)]


def banks(camera, features):
    """Registers that are the same behind all values of a selector: firmware has one for each."""
    found = {}
    for selector in features:
        node = camera.node(selector)
        entries = camera.entries(selector)
        if len(entries) < 2 or not selector.endswith("Selector"):
            continue
        places = [set(kept(camera, lambda e=entry: put(camera, selector, e))) for entry in entries[:3]]
        if not places[0] or len(places[0]) != 1:
            continue
        (by,) = places[0]
        for selected in [part.node.name for part in node.node.selected_features]:
            where = []
            for entry in entries[:3]:
                def write(e=entry):
                    put(camera, selector, e)
                    camera.memory.wrote = []
                    again(camera, selected)
                where.append(set(kept(camera, write)))
            if where[0] and where[0] == where[1] and by not in where[0]:
                for at in where[0]:
                    found.setdefault(at, [])
                    if by not in found[at]:
                        found[at].append(by)
    # A register that selects is not selected itself: the simulator follows one step.
    selectors = {by for others in found.values() for by in others}
    return [[at, by] for at, by in found.items() if at not in selectors]


def put(camera, name, value):
    node = camera.node(name, by_maker=True)
    node.from_string(str(value))
    camera.forget()


def again(camera, name):
    """Writes a value that is valid."""
    node = camera.node(name, by_maker=True)
    if tag(camera.nodes[name]) == "Command" or hasattr(node, "execute"):
        return
    if isinstance(node, genapi.IEnumeration):
        node.from_string(camera.entries(name)[0])
    elif is_number(node):
        if camera.has_steps(name, by_maker=True):
            node.set_value(node.min)
    else:
        node.set_value(node.value)
