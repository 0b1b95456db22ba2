// SPDX-License-Identifier: MIT OR Apache-2.0
//! Pixel formats by the names that cameras give them: codes of the PFNC and of GigE Vision 1.

/// Name and code; a code has the number of bits of a pixel, and whether it has a colour.
const CODES: &[(&str, u32)] = &[
    ("Mono8", 0x0108_0001),
    ("Mono10", 0x0110_0003),
    ("Mono10Packed", 0x010c_0004),
    ("Mono12", 0x0110_0005),
    ("Mono12Packed", 0x010c_0006),
    ("Mono14", 0x0110_0025),
    ("Mono16", 0x0110_0007),
    ("Mono10p", 0x010a_0046),
    ("Mono12p", 0x010c_0047),
    ("BayerGR8", 0x0108_0008),
    ("BayerRG8", 0x0108_0009),
    ("BayerGB8", 0x0108_000a),
    ("BayerBG8", 0x0108_000b),
    ("BayerGR10", 0x0110_000c),
    ("BayerRG10", 0x0110_000d),
    ("BayerGB10", 0x0110_000e),
    ("BayerBG10", 0x0110_000f),
    ("BayerGR12", 0x0110_0010),
    ("BayerRG12", 0x0110_0011),
    ("BayerGB12", 0x0110_0012),
    ("BayerBG12", 0x0110_0013),
    ("BayerGR10Packed", 0x010c_0026),
    ("BayerRG10Packed", 0x010c_0027),
    ("BayerGB10Packed", 0x010c_0028),
    ("BayerBG10Packed", 0x010c_0029),
    ("BayerGR12Packed", 0x010c_002a),
    ("BayerRG12Packed", 0x010c_002b),
    ("BayerGB12Packed", 0x010c_002c),
    ("BayerBG12Packed", 0x010c_002d),
    ("BayerGR16", 0x0110_002e),
    ("BayerRG16", 0x0110_002f),
    ("BayerGB16", 0x0110_0030),
    ("BayerBG16", 0x0110_0031),
    ("BayerBG10p", 0x010a_0052),
    ("BayerBG12p", 0x010c_0053),
    ("BayerGB10p", 0x010a_0054),
    ("BayerGB12p", 0x010c_0055),
    ("BayerGR10p", 0x010a_0056),
    ("BayerGR12p", 0x010c_0057),
    ("BayerRG10p", 0x010a_0058),
    ("BayerRG12p", 0x010c_0059),
    ("RGB8", 0x0218_0014),
    ("RGB8Packed", 0x0218_0014),
    ("BGR8", 0x0218_0015),
    ("BGR8Packed", 0x0218_0015),
    ("RGBA8Packed", 0x0220_0016),
    ("RGBa8", 0x0220_0016),
    ("BGRA8Packed", 0x0220_0017),
    ("BGRa8", 0x0220_0017),
    ("RGB10Packed", 0x0230_0018),
    ("RGB12Packed", 0x0230_001a),
    ("RGB8Plannar", 0x0218_0021),
    ("RGB10Plannar", 0x0230_0022),
    ("RGB12Plannar", 0x0230_0023),
    ("RGB16Plannar", 0x0230_0024),
    ("YUV411Packed", 0x020c_001e),
    ("YUV411_8_UYYVYY", 0x020c_001e),
    ("YUV422Packed", 0x0210_001f),
    ("YUV422_8_UYVY", 0x0210_001f),
    ("YUYVPacked", 0x0210_0032),
    ("YUV422_YUYV_Packed", 0x0210_0032),
    ("YUV422_8", 0x0210_0032),
    ("YUV444Packed", 0x0218_0020),
    ("YUV8_UYV", 0x0218_0020),
    ("YCbCr8", 0x0218_005b),
    ("YCbCr411_8", 0x020c_005a),
    ("YCbCr422_8", 0x0210_003b),
    ("YCBCR709_422", 0x0210_0040),
];
/// Where codes of vendors' own begin: 16 bits a pixel, as the most of them have.
const OWN: u32 = 0x8110_0000;

/// The code of the format that is entry number `place` of a camera.
pub fn code(name: &str, place: usize) -> u32 {
    let known = CODES.iter().find(|(known, _)| *known == name).map(|(_, code)| *code);
    known.unwrap_or_else(|| OWN | u32::try_from(place & 0xffff).unwrap_or(0))
}

/// Whether a format has no colour.
pub fn is_grey(name: &str) -> bool {
    name.starts_with("Mono")
}
