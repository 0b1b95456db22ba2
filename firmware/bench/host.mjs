// SPDX-License-Identifier: MIT OR Apache-2.0
// The host's end of the protocol (docs/design/hsu-protocol.md), written from its tables and not from the crate.

export function crc32(bytes) {
  let crc = 0xffffffff;
  for (const byte of bytes) {
    crc ^= byte;
    for (let i = 0; i < 8; i++) crc = crc & 1 ? (crc >>> 1) ^ 0xedb88320 : crc >>> 1;
  }
  return ~crc >>> 0;
}

export function frame(message) {
  const out = [0];
  let code = out.push(0) - 1;
  for (const byte of Buffer.concat([message, u32(crc32(message))])) {
    if (byte !== 0) { out.push(byte); continue; }
    out[code] = out.length - code;
    code = out.push(0) - 1;
  }
  out[code] = out.length - code;
  out.push(0);
  return Buffer.from(out);
}

/** Messages from bytes. */
export class Decoder {
  constructor() { this.bytes = []; this.bad = 0; }

  push(byte) {
    if (byte !== 0) { this.bytes.push(byte); return null; }
    const stuffed = this.bytes;
    this.bytes = [];
    if (stuffed.length === 0) return null;
    const out = [];
    for (let at = 0; at < stuffed.length;) {
      const end = at + stuffed[at];
      out.push(...stuffed.slice(at + 1, end));
      at = end;
      if (at < stuffed.length) out.push(0);
    }
    const body = Buffer.from(out);
    if (body.length < 6 || crc32(body.subarray(0, -4)) !== body.readUInt32LE(body.length - 4)) { this.bad++; return null; }
    return body.subarray(0, -4);
  }
}

const u64 = (n) => { const b = Buffer.alloc(8); b.writeBigUInt64LE(BigInt(n)); return b; };
const u32 = (n) => { const b = Buffer.alloc(4); b.writeUInt32LE(n); return b; };
const name = (text) => { const b = Buffer.alloc(16); b.write(text); return b; };
const request = (kind, ...fields) => (id) => Buffer.concat([Buffer.from([1, kind]), u32(id), ...fields]);

export function timing(periodNs, silenceNs, heads) {
  const list = heads.flatMap(([delay, exposure]) => [u64(delay), u64(exposure)]);
  return Buffer.concat([u64(periodNs), Buffer.from([0]), u64(silenceNs), Buffer.from([heads.length]), ...list]);
}

export const hello = (node) => request(0, Buffer.from([1, 1]), name(node));
export const configure = (fields) => request(1, fields);
export const arm = (session, count, warmUp, fields, nodes) =>
  request(3, session, u64(count), u32(warmUp), u32(Math.max(1, crc32(fields))), ...nodes.map(name));
export const start = (session) => request(4, session);
export const readClock = () => request(7, u64(1));
export const readStatus = () => request(9);
export const queryEdges = (first) => request(13, u64(first));

const status = (m, at) => ({ state: m[at], late: m.readUInt32LE(at + 48), faults: m.readUInt32LE(at + 52), framesBad: m.readUInt32LE(at + 56), unsent: m.readUInt32LE(at + 60) });
const edge = (m, at) => ({ number: Number(m.readBigUInt64LE(at)), ns: Number(m.readBigUInt64LE(at + 8)), input: m[at + 16], rising: m[at + 17] === 1 });

/** A message of the unit; what it says unasked has no id. */
export function read(m) {
  const kind = m[1], id = m.readUInt32LE(2);
  switch (kind) {
    case 0x80: return { kind: 'welcome', id, product: m.toString('latin1', 6, 22).replace(/\0+$/, ''), uid: m.toString('latin1', 22, 38), firmware: [38, 40, 42].map((at) => m.readUInt16LE(at)) };
    case 0x81: return { kind: 'ack', id };
    case 0x82: return { kind: 'refused', id, code: m[6] };
    case 0x83: return { kind: 'timing', id };
    case 0x84: return { kind: 'clock', id, ns: Number(m.readBigUInt64LE(14)) };
    case 0x86: return { kind: 'status', id, ...status(m, 6) };
    case 0x87: return { kind: 'heartbeat', ...status(m, 2) };
    case 0x88: return { kind: 'trigger', number: Number(m.readBigInt64LE(18)), ns: Number(m.readBigUInt64LE(26)), flags: m[34] };
    case 0x89: return { kind: 'done', emitted: Number(m.readBigUInt64LE(18)), reason: m[26] };
    case 0x8a: return { kind: 'fault', code: m[18], value: Number(m.readBigUInt64LE(19)) };
    case 0x8b: return { kind: 'edges', id, edges: Array.from({ length: m[15] }, (_, i) => edge(m, 16 + 20 * i)) };
    default: return { kind: kind.toString(16), id };
  }
}
