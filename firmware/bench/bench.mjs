// SPDX-License-Identifier: MIT OR Apache-2.0
// The firmware in emulated time: two hosts on saturated lines, every edge of every output, a processor that is held up,
// one that crashes. bench.mjs FIRMWARE SUMMARY TRIGGERS VERSION COMMIT
import { writeFileSync } from 'node:fs';
import { cpus } from 'node:os';
import * as host from './host.mjs';
import { Pico } from './pico.mjs';

const [firmware, summaryPath, triggers, version, commit] = process.argv.slice(2);
const PERIOD = Math.round(1e9 / 120), WARM_UP = 8;
/** Delay and exposure of heads: one on no grid of the player's, two closer than its clock can tell apart. */
const HEADS = [[200_000, 1_000_000], [300_000, 1_000_000], [1_250_008, 2_000_000], [200_040, 1_000_000]];
const SYNC_PIN = 14, SESSION_PIN = 15, OUTPUTS = [6, 7, 8, 9, 10, 11, 12, 13, 14, 15], INPUT_PINS = [16, 17, 18, 19, 20, 21, 22, 26];
/** Requests that each host has open at any time: their answers, and what is told of triggers, fill its line. */
const OPEN = 4;
const LIMITS = { edge_spread_ns: 16, flash_bytes: 64 * 1024, stack_bytes: 6 * 1024, input_error_ns: 50_000 };
const FAULT_HARDWARE = 3, HELD_UP = 1, LATE = 4;

const violations = [];
const expect = (is, text) => { if (!is) violations.push(text); };

/** A board with two hosts. */
class Bench {
  constructor({ exact = false } = {}) {
    this.edges = [];
    this.said = [];
    this.answers = [];
    this.bytes = 0;
    this.restarts = [];
    this.open = [0, 0];
    const decoders = [new host.Decoder(), new host.Decoder()];
    this.decoders = decoders;
    this.pico = new Pico(firmware, {
      onEdge: (pin, high, ns) => this.edges.push({ pin, high, ns }),
      onByte: (link, byte, ns) => {
        this.bytes++;
        const message = decoders[link].push(byte);
        if (!message) return;
        const what = { link, at: ns, ...host.read(message) };
        if (what.kind === 'done') this.done++;
        if (what.id !== undefined) this.open[link]--;
        (what.id === undefined ? this.said : this.answers).push(what);
      },
      onWatchdog: (ns) => this.restarts.push(ns),
    });
    this.pico.exact = exact;
    this.id = 0;
    this.session = 0;
    this.done = 0;
  }

  send(link, message) { this.open[link]++; this.pico.send(link, host.frame(message(++this.id))); return this.id; }

  ask(link, message) {
    const id = this.send(link, message);
    for (const end = this.pico.ns + 100e6; this.pico.ns < end;) {
      this.pico.run(this.pico.ns + 50e3);
      const answer = this.answers.find((one) => one.id === id && one.link === link);
      if (answer) return answer;
    }
    throw new Error(`expected an answer to request ${id} on link ${link}, found none in 0.1 s; complaints: ${[...this.pico.complaints].slice(0, 5)}`);
  }

  greet() {
    this.pico.run(5e6);
    return ['a', 'b'].map((node, link) => this.ask(link, host.hello(node)));
  }

  /** One train; `at(ns since start)` is called before each stretch, and says how long it may be. */
  train(count, at) {
    this.edges.length = 0;
    this.said.length = 0;
    this.done = 0;
    const session = Buffer.alloc(16, ++this.session);
    const fields = host.timing(PERIOD, 2e9, HEADS);
    for (const link of [0, 1]) {
      const set = this.ask(link, host.configure(fields)), armed = this.ask(link, host.arm(session, count, WARM_UP, fields, ['a', 'b']));
      if (set.kind !== 'timing' || armed.kind !== 'ack') throw new Error(`expected to be armed: ${JSON.stringify([set, armed])}`);
    }
    const started = this.ask(0, host.start(session));
    if (started.kind !== 'ack') throw new Error(`expected to be started: ${JSON.stringify(started)}`);
    const from = this.pico.ns;
    for (const end = from + (count + WARM_UP + 20) * PERIOD * 1.3; this.pico.ns < end && this.done < 2;) {
      this.pico.run(this.pico.ns + at(this.pico.ns - from));
    }
    this.pico.run(this.pico.ns + 20e6);
  }

  of(kind, link = 0) { return this.said.filter((m) => m.kind === kind && m.link === link); }

  /** Rise less told time and delay of every edge, ns; numbers, widths and both tables are checked on the way. */
  errors(name, count) {
    const told = this.of('trigger'), other = this.of('trigger', 1);
    const table = (list) => JSON.stringify(list.map((t) => [t.number, t.ns, t.flags]));
    expect(table(told) === table(other), `${name}: both hosts were told the same triggers`);
    expect(told.length === count + WARM_UP && told.every((t, i) => t.number === i - WARM_UP), `${name}: ${told.length} triggers told, expected ${count + WARM_UP}`);
    expect(this.of('done').length === 1 && this.of('done')[0].emitted === count, `${name}: done with ${count} triggers`);
    const errors = [];
    [[SYNC_PIN, 0, 100_000], ...HEADS.map(([delay, exposure], head) => [6 + head, delay, exposure])].forEach(([pin, delay, width]) => {
      const rises = this.edges.filter((e) => e.pin === pin && e.high), falls = this.edges.filter((e) => e.pin === pin && !e.high);
      expect(rises.length === told.length && falls.length === told.length, `${name}: ${rises.length} rises and ${falls.length} falls of pin ${pin}, expected ${told.length}`);
      rises.slice(0, told.length).forEach((rise, i) => errors.push(rise.ns - told[i].ns - delay));
      const widths = new Set(falls.map((fall, i) => fall.ns - rises[i]?.ns));
      expect(widths.size === 1 && widths.has(width), `${name}: widths of pin ${pin} are ${[...widths].slice(0, 5)} ns, expected ${width}`);
    });
    const session = this.edges.filter((e) => e.pin === SESSION_PIN);
    expect(session.length === 2 && session[0].high && session[1].ns > this.edges.findLast((e) => e.pin < SYNC_PIN).ns,
      `${name}: the session's output rises once, and falls after the last exposure`);
    return errors;
  }
}

const spread = (list) => list.reduce(([low, high], x) => [Math.min(low, x), Math.max(high, x)], [Infinity, -Infinity]);
const within = (name, errors, [low]) => {
  const [first, last] = spread(errors);
  expect(first >= low - LIMITS.edge_spread_ns && last <= low + LIMITS.edge_spread_ns, `${name}: edges ${first - low} to ${last - low} ns off, expected ${LIMITS.edge_spread_ns}`);
  return [first, last];
};

// The loops of the PIO that are played in one go, against every instruction.
const [fast, exact] = [{}, { exact: true }].map((how) => {
  const bench = new Bench(how);
  bench.greet();
  bench.train(2, () => 50e3);
  return JSON.stringify(bench.edges);
});
expect(fast === exact, 'edges are the same with every instruction of the PIO played');

// A train on saturated lines, with edges at inputs.
const began = Date.now();
const bench = new Bench();
const welcomes = bench.greet();
expect(bench.edges.length === 0, 'no output moves before a session');
welcomes.forEach((welcome, link) => {
  const found = JSON.stringify([welcome.product, welcome.uid, welcome.firmware.join('.')]);
  const expected = JSON.stringify(['fourdbody-hsu', 'e6605838834f2a31', version]);
  expect(found === expected, `welcome on link ${link}: ${found}, expected ${expected}`);
});
const inputs = [];
let due = 0;
bench.bytes = 0;
const before = bench.pico.ns;
bench.train(Number(triggers), (ns) => {
  [0, 1].forEach((link) => { while (bench.open[link] < OPEN) bench.send(link, host.readClock()); });
  if (ns >= due && inputs.length < 64) {
    const input = inputs.length % INPUT_PINS.length, high = inputs.length % 16 < 8;
    bench.pico.input(INPUT_PINS[input], high);
    inputs.push({ input, rising: high, ns: bench.pico.ns });
    due += 13_337_000;
  }
  bench.answers = bench.answers.slice(-16);
  return Math.max(1, Math.min(50e3, due > ns ? due - ns : Infinity));
});
const offered = bench.bytes * 1e10 / 920810 / 2 / (bench.pico.ns - before);
const offset = spread(bench.errors('train', Number(triggers)));
expect(offset[1] - offset[0] <= LIMITS.edge_spread_ns, `edges spread over ${offset[1] - offset[0]} ns, expected ${LIMITS.edge_spread_ns}`);
expect(bench.of('fault').length === 0, `no faults in a train: ${JSON.stringify(bench.of('fault').slice(0, 3))}`);
expect(bench.of('trigger').every((t) => (t.flags & LATE) === 0), 'no late trigger in a train');
const status = bench.ask(0, host.readStatus());
expect(status.unsent === 0 && status.framesBad === 0 && status.late === 0, `status after a train: ${JSON.stringify(status)}`);
let heard = [];
for (let more = true; more;) {
  const { edges } = bench.ask(1, host.queryEdges(heard.length));
  heard = heard.concat(edges);
  more = edges.length > 0;
}
expect(heard.length === inputs.length && heard.every((e, i) => e.input === inputs[i].input && e.rising === inputs[i].rising), `${heard.length} edges of inputs, expected ${inputs.length}`);
const inputError = Math.round(Math.max(...heard.map((e, i) => Math.abs(e.ns - (inputs[i]?.ns ?? 0)))));
expect(inputError <= LIMITS.input_error_ns, `an edge of an input is ${inputError} ns off, expected ${LIMITS.input_error_ns}`);

// The processor is held up at many moments of a period, for longer than a trigger is planned ahead.
const HOLDS = 24, HOLD_NS = 20e6, EVERY = 8;
let holds = 0;
bench.train(HOLDS * EVERY + 8, (ns) => {
  if (holds < HOLDS && ns >= (WARM_UP + 6 + (holds + 1) * EVERY + (holds + 1) / HOLDS) * PERIOD) {
    bench.pico.hold(HOLD_NS);
    holds++;
  }
  return 10e3;
});
const held = within('held up', bench.errors('held up', HOLDS * EVERY + 8), offset);
const faults = bench.of('fault').filter((f) => f.code === FAULT_HARDWARE);
expect(holds === HOLDS && faults.length >= HOLDS && faults.every((f) => f.value === HELD_UP), `${faults.length} faults told of ${HOLDS} stalls: ${JSON.stringify([...new Set(faults.map((f) => f.value))])}`);
const late = bench.of('trigger').filter((t) => t.flags & LATE).length;
expect(late >= HOLDS && bench.ask(0, host.readStatus()).late === late, `${late} late triggers of ${HOLDS} stalls, as status counts them`);

// A processor that crashes while lines are high, and one that hangs.
function lost(name, provoke) {
  const one = new Bench();
  one.greet();
  let done = 0;
  try {
    one.train(20, () => {
      if (!done && one.edges.findLast((e) => e.pin === 6)?.high) { done = one.pico.ns; provoke(one.pico); }
      if (one.restarts.length) throw new Stopped();
      return 5e3;
    });
  } catch (stop) { if (!(stop instanceof Stopped)) throw stop; }
  expect(done > 0 && one.restarts.length === 1 && one.restarts[0] - done <= 210e6, `${name}: the watchdog restarts the board`);
  const high = OUTPUTS.filter((pin) => one.edges.findLast((e) => e.pin === pin)?.high);
  const last = Math.max(...one.edges.map((e) => e.ns));
  return { high, afterNs: last - done };
}
class Stopped extends Error {}
const crashed = lost('crash', (pico) => pico.crash());
expect(crashed.high.length === 0 && crashed.afterNs < 20e3, `crash: outputs ${crashed.high} stay high; the last edge comes after ${crashed.afterNs} ns`);
lost('hang', (pico) => pico.hold(10e9));

const { flashBytes, stackBytes, overruns, complaints } = bench.pico;
expect(flashBytes <= LIMITS.flash_bytes, `${flashBytes} bytes of flash, expected at most ${LIMITS.flash_bytes}`);
expect(stackBytes <= LIMITS.stack_bytes, `${stackBytes} bytes of stack, expected at most ${LIMITS.stack_bytes}`);
expect(bench.decoders.every((d) => d.bad === 0), 'no bad frame came from the unit');
const rows = [
  ['triggers in the train', triggers],
  ['edges after the fixed offset, ns', `0 to ${offset[1] - offset[0]} (offset ${offset[0]})`],
  ['the same, held up 24 times for 20 ms, ns', `${held[0] - offset[0]} to ${held[1] - offset[0]}`],
  ['of these told as faults; late triggers', `${faults.length}; ${late}`],
  ['both lines in use while the train ran', `${(100 * offered).toFixed(0)} %`],
  ['edges of inputs, off by at most, ns', inputError],
  ['outputs low after a crash, ns', crashed.afterNs],
  ['flash, bytes', flashBytes],
  ['stack, bytes', stackBytes],
];
rows.forEach(([what, figure]) => console.log(`${what.padEnd(44)} ${figure}`));
writeFileSync(summaryPath, `${JSON.stringify({
  commit, machine: `${cpus().length} x ${cpus()[0].model}`, seed: 0, triggers: Number(triggers),
  edge_spread_ns: offset[1] - offset[0], edge_offset_ns: offset[0], violations: violations.length, stalls: holds, stalls_told: faults.length,
  late_triggers: late, lines_in_use_share: Number(offered.toFixed(3)), input_error_ns: inputError, low_after_crash_ns: crashed.afterNs,
  text_bytes: flashBytes, stack_bytes: stackBytes, receive_overruns: overruns[0] + overruns[1], real_s: (Date.now() - began) / 1e3,
}, null, 2)}\n`);
complaints.forEach((text) => console.log(`the emulator complains: ${text}`));
violations.forEach((text) => console.error(`error: ${text}`));
process.exit(violations.length ? 1 : 0);
