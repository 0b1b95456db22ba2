// SPDX-License-Identifier: MIT OR Apache-2.0
// A Raspberry Pi Pico in emulated time: rp2040js with what it lacks for measuring. Its PIO runs from a JavaScript timer;
// here it keeps step with the processor, and tells the time of every edge. Its UARTs get a baud rate and a FIFO, its
// flash a number, and its boot ROM the functions that are called.
import { readFileSync } from 'node:fs';
import { GPIOPinState, RP2040 } from 'rp2040js';

const CYCLE_NS = 8;
const BYTE_NS = 1e10 / 920810;
const FIFO_BYTES = 32;
const RAM = 0x20000000, RAM_BYTES = 256 * 1024;
const LOOPS = { jmpXNotY: 0x00a0, jmpXDec: 0x0040, pullNoblock: 0x8080 };

export class Pico {
  /** `path` without .elf and .uf2. onEdge(pin, high, ns), onByte(link, byte, ns), onWatchdog(ns) */
  constructor(path, { onEdge, onByte, onWatchdog }) {
    this.chip = new RP2040();
    this.clock = this.chip.clock;
    this.complaints = new Set();
    // Pins of the flash, and thresholds of the UARTs' FIFOs.
    const known = /^(IO_QSPI_BASE|UART\d: Unimplemented peripheral write to 0x34)/;
    const complain = (name, text) => { if (!known.test(`${name}: ${text}`)) this.complaints.add(`${name}: ${text}`); };
    this.chip.logger = { debug() {}, info() {}, warn: complain, error: complain };
    this.onByte = onByte;
    /** When the PIO has more to do than to count. */
    this.playNs = 0;
    /** While the PIO is played: when it sets pins. */
    this.edgeNs = null;
    this.instructions = 0;
    this.heldUntil = 0;
    this.toHold = 0;
    this.overruns = [0, 0];
    this.tx = [[], []];
    this.txFree = [0, 0];
    this.rx = [[], []];
    this.rxNext = [0, 0];
    this.chip.sram.fill(0xa5);
    this.load(path);
    this.patchUarts();
    this.patchPio();
    this.patchFlash([0xe6, 0x60, 0x58, 0x38, 0x83, 0x4f, 0x2a, 0x31]);
    const watchdog = this.chip.peripherals[0x40058];
    // The board would restart; here it is only told, once.
    watchdog.onWatchdogTrigger = () => { watchdog.alarm.enable = false; onWatchdog(this.ns); };
    this.chip.gpio.forEach((pin, number) => pin.addListener((value, before) => {
      const [now, then] = [value, before].map((state) => state === GPIOPinState.High);
      if (now !== then) onEdge(number, now, this.edgeNs ?? this.ns);
    }));
    const { core } = this.chip;
    core.VTOR = 0x10000100;
    core.SP = this.chip.readUint32(core.VTOR);
    core.PC = (this.chip.readUint32(core.VTOR + 4) & ~1) >>> 0;
  }

  get ns() { return this.clock.nanosCounter; }

  /** The flash's content, from the file that a board takes; from the ELF where the memory ends that has a name. */
  load(path) {
    const uf2 = readFileSync(`${path}.uf2`), elf = readFileSync(`${path}.elf`);
    for (let at = 0; at < uf2.length; at += 512) {
      const [address, bytes] = [uf2.readUInt32LE(at + 12), uf2.readUInt32LE(at + 16)];
      this.chip.flash.set(uf2.subarray(at + 32, at + 32 + bytes), address - 0x10000000);
      this.flashBytes = address - 0x10000000 + bytes;
    }
    const headers = elf.readUInt32LE(28), size = elf.readUInt16LE(42);
    for (let at = headers; at < headers + size * elf.readUInt16LE(44); at += size) {
      const [type, virtual, memory] = [0, 8, 20].map((field) => elf.readUInt32LE(at + field));
      if (type === 1 && virtual >= RAM) this.namedEnd = Math.max(this.namedEnd ?? 0, virtual + memory);
    }
  }

  patchFlash(id) {
    // The ROM's table, its look-up function, and the one function that it finds: `bx lr`.
    Object.assign(this.chip.bootrom, { 5: 0, 6: 0x21, 8: 0x47702031, 12: 0x4770 });
    const ssi = this.chip.peripherals[0x18000];
    const { readUint32, writeUint32 } = ssi;
    const answers = [...Array(5).fill(0), ...id];
    let next = answers.length;
    const received = [];
    ssi.writeUint32 = (offset, value) => {
      if (offset === 0x60 && value === 0x4b && next === answers.length) next = 0;
      if (offset === 0x60 && next < answers.length) received.push(answers[next++]);
      else writeUint32.call(ssi, offset, value);
    };
    ssi.readUint32 = (offset) => (offset === 0x60 && received.length ? received.shift() : readUint32.call(ssi, offset));
  }

  patchUarts() {
    this.chip.uart.forEach((uart, link) => {
      Object.defineProperty(uart, 'flags', {
        get: () => {
          this.drain(link);
          const full = this.tx[link].length >= FIFO_BYTES;
          return (uart.rxFIFO.full ? 1 << 6 : 0) | (uart.rxFIFO.empty ? 1 << 4 : 0)
            | (full ? 1 << 5 : 0) | (this.tx[link].length === 0 ? 1 << 7 : 1 << 3);
        },
      });
      uart.onByte = (byte) => {
        this.drain(link);
        if (this.tx[link].length >= FIFO_BYTES) this.complaints.add('UART: written while full');
        this.txFree[link] = Math.max(this.ns, this.txFree[link]) + BYTE_NS;
        this.tx[link].push([this.txFree[link], byte]);
      };
    });
  }

  /** Tells bytes whose last bit is out. */
  drain(link) {
    const queue = this.tx[link];
    while (queue.length > 0 && queue[0][0] <= this.ns) {
      const [ns, byte] = queue.shift();
      this.onByte(link, byte, ns);
    }
  }

  /** Bytes that a host sends from now on, at the baud rate. */
  send(link, bytes) {
    let at = Math.max(this.ns, this.rxNext[link]);
    for (const byte of bytes) this.rx[link].push([at += BYTE_NS, byte]);
    this.rxNext[link] = at;
  }

  deliver() {
    let next = Infinity;
    this.rx.forEach((queue, link) => {
      const uart = this.chip.uart[link];
      while (queue.length > 0 && queue[0][0] <= this.ns) {
        if (uart.rxFIFO.full) { this.overruns[link]++; queue.shift(); } else uart.feedByte(queue.shift()[1]);
      }
      if (queue.length > 0) next = Math.min(next, queue[0][0]);
    });
    return next;
  }

  input(pin, high) { this.chip.gpio[pin].setInputValue(high); }

  patchPio() {
    const pio = this.chip.pio[0];
    this.pio = pio;
    pio.run = () => {};
    const { readUint32, writeUint32 } = pio;
    pio.machines.forEach((machine) => { machine.at = 0; });
    pio.readUint32 = (offset) => { this.play(); return readUint32.call(pio, offset); };
    pio.writeUint32 = (offset, value) => {
      this.play();
      const before = pio.machines.map((machine) => machine.enabled);
      writeUint32.call(pio, offset, value);
      pio.machines.forEach((machine, i) => { if (machine.enabled && (!before[i] || machine.at < this.cycle)) machine.at = Math.max(machine.at, this.cycle); });
      pio.checkChangedPins();
      this.playNs = 0;
    };
  }

  get cycle() { return Math.floor(this.ns / CYCLE_NS); }

  /** How many cycles a machine stays in a loop that only counts, and what a turn of it does; null where it is in none. */
  loop(machine) {
    const { instructions } = this.pio, { pc } = machine, opcode = instructions[pc];
    if (opcode === (LOOPS.jmpXDec | pc)) return { turn: 1, counts: 1, turns: machine.x };
    // jmp x!=y to a jmp x-- in front of it.
    if (opcode === (LOOPS.jmpXNotY | (pc - 1)) && instructions[pc - 1] === (LOOPS.jmpXDec | pc)) {
      return { turn: 2, counts: 1, turns: (machine.x - machine.y) >>> 0 };
    }
    // Three counts, a pull of nothing, and back.
    if (pc === machine.wrapBottom && instructions[pc + 3] === LOOPS.pullNoblock && machine.wrapTop === pc + 5 && machine.txFIFO.empty) {
      return { turn: 6, counts: 3, turns: Infinity };
    }
    return null;
  }

  /** PIO up to now: instruction by instruction, the earliest machine first; loops that only count in one go. */
  play() {
    const now = this.cycle;
    for (;;) {
      let machine;
      for (const one of this.pio.machines) {
        if (one.enabled && !one.waiting && one.at < now && (!machine || one.at < machine.at)) machine = one;
      }
      if (!machine) { this.playNs = this.nextPlay; return; }
      const loop = this.exact ? null : this.loop(machine);
      const turns = loop ? Math.min(loop.turns, Math.floor((now - machine.at) / loop.turn)) : 0;
      if (turns > 0) {
        machine.x = (machine.x - turns * loop.counts) >>> 0;
        machine.at += turns * loop.turn;
        continue;
      }
      const asleep = this.pio.machines.filter((one) => one.enabled && one.waiting);
      const before = machine.cycles;
      machine.step();
      machine.at += Math.max(1, machine.cycles - before);
      asleep.filter((one) => !one.waiting).forEach((one) => { one.at = machine.at; });
      this.edgeNs = machine.at * CYCLE_NS;
      this.pio.checkChangedPins();
      this.edgeNs = null;
    }
  }

  /** When the PIO does more than count. */
  get nextPlay() {
    let next = Infinity;
    for (const machine of this.pio.machines) {
      if (!machine.enabled || machine.waiting) continue;
      const loop = this.loop(machine);
      next = Math.min(next, machine.at + 1 + (loop ? loop.turns * loop.turn : 0));
    }
    return next * CYCLE_NS;
  }

  /** Runs up to a time. */
  run(until) {
    const { clock, chip: { core } } = this;
    let nextByte = this.deliver();
    while (clock.nanosCounter < until) {
      if (this.toHold && (core.waiting || !core.PM)) {
        this.heldUntil = this.ns + this.toHold;
        this.toHold = 0;
      }
      // `wfi` with masked interrupts returns where one is pending; rp2040js would sleep.
      if (core.waiting && core.pendingInterrupts & core.enabledInterrupts) core.waiting = false;
      if (core.waiting || clock.nanosCounter < this.heldUntil) {
        const alarm = clock.nextAlarm ? clock.nextAlarm.nanos : Infinity;
        const held = clock.nanosCounter < this.heldUntil ? this.heldUntil : Infinity;
        const next = Math.min(until, alarm, nextByte, held, this.playNs);
        clock.tick(Math.max(CYCLE_NS, next - clock.nanosCounter));
      } else {
        clock.tick(core.executeInstruction() * CYCLE_NS);
        this.instructions++;
      }
      if (clock.nanosCounter >= this.playNs) this.play();
      if (clock.nanosCounter >= nextByte) nextByte = this.deliver();
    }
    this.drain(0);
    this.drain(1);
  }

  /** The processor does nothing for so long, as in an interrupt: not where it has masked them. All else goes on. */
  hold(ns) { this.toHold = ns; }

  /** The processor meets an instruction that there is not. */
  crash() {
    this.chip.core.waiting = false;
    this.chip.core.PC = this.chip.readUint32(this.chip.core.VTOR + 12) & ~1;
  }

  /** Bytes of stack that were ever used: memory was filled before. */
  get stackBytes() {
    let at = this.namedEnd - RAM;
    while (at < RAM_BYTES && this.chip.sram[at] === 0xa5) at++;
    return RAM_BYTES - at;
  }
}
