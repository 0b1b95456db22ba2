# SPDX-License-Identifier: MIT OR Apache-2.0
"""uf2.py ELF UF2: the flash's content as the file that a Raspberry Pi Pico takes by drag and drop."""
import pathlib
import struct
import sys

FLASH, PAGE, RP2040 = 0x10000000, 256, 0xE48BFF56
elf = pathlib.Path(sys.argv[1]).read_bytes()
(table,), (size, count) = struct.unpack_from("<I", elf, 28), struct.unpack_from("<HH", elf, 42)
flash = bytearray()
for i in range(count):
    kind, offset, _, address, length = struct.unpack_from("<5I", elf, table + i * size)
    if kind == 1 and length > 0:
        start = address - FLASH
        flash.extend(bytes(max(0, start + length - len(flash))))
        flash[start : start + length] = elf[offset : offset + length]
flash.extend(bytes(-len(flash) % PAGE))
blocks = len(flash) // PAGE
with open(sys.argv[2], "wb") as out:
    for i in range(blocks):
        # Magic numbers, the flag "a family follows", and a page padded to 476 bytes (github.com/microsoft/uf2).
        out.write(struct.pack("<8I", 0x0A324655, 0x9E5D5157, 0x2000, FLASH + i * PAGE, PAGE, i, blocks, RP2040))
        out.write(flash[i * PAGE : (i + 1) * PAGE].ljust(476, b"\0") + struct.pack("<I", 0x0AB16F30))
