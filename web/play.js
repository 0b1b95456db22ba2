// The console's player: a session that the worker of a node's machine has reconstructed, frame set by frame set from that
// node. `/play.html?session=NAME&node=NODE`; without a node it is the one that serves the page.

import { $, text } from "./elements.js";
import { Gone, Refused, node } from "./node-client.js";
import { Player } from "./player.js";
import { number, t } from "./words.js";

/** Packed points that are kept, bytes: all frame sets of ten seconds at 120 Hz. Of a longer session those about the play head. */
const PACKED_BYTES = 400 << 20;
/** Of what is kept, so much lies before the play head. */
const BEFORE = 0.25;
/** Frame sets that are asked for at the same time: the node makes one after the other. */
const FLYING = 2;
const RETRY_MS = 500;

const wanted = new URLSearchParams(location.search);
const [session, peer] = [wanted.get("session") ?? "", wanted.get("node") ?? ""];

const pause = (ms, signal) =>
  new Promise((resolve, reject) => {
    const waiting = setTimeout(resolve, ms);
    signal?.addEventListener("abort", () => {
      clearTimeout(waiting);
      reject(signal.reason);
    });
  });

/** Asks until there is an answer: what passes by itself (a session, a node that is busy or away) is told and waited for. */
async function persist(asking, signal) {
  for (;;) {
    try {
      const answer = await asking();
      text($("player-state"), "");
      return answer;
    } catch (error) {
      if (signal?.aborted) throw signal.reason;
      const passes = error instanceof Gone || (error instanceof Refused && [401, 409, 429, 503].includes(error.status));
      if (!passes) throw error;
      text($("player-state"), error.status === 401 ? t("play-login") : error.message);
      await pause(RETRY_MS, signal);
    }
  }
}

/** The frame sets of a session, as the node makes them. What the player asks for comes first; then all others, from the play head on. */
class NodeSource {
  constructor(described) {
    this.described = described;
    this.triggers = described.runs.flatMap(([first, last]) => Array.from({ length: last - first + 1 }, (_, i) => first + i));
    this.places = new Map(this.triggers.map((trigger, place) => [trigger, place]));
    this.kept = new Map();
    this.bytes = 0;
    /** Asked for by the player, not yet of the node: trigger to {promise, resolve, reject}. */
    this.due = new Map();
    this.flying = new Map();
    this.failed = new Set();
    this.head = 0;
    this.onKept = () => {};
    document.addEventListener("visibilitychange", () => this.pump());
  }

  packed(trigger) {
    const kept = this.kept.get(trigger);
    if (kept) return Promise.resolve(new Blob([kept]).stream());
    let due = this.due.get(trigger);
    if (!due) {
      due = Promise.withResolvers();
      this.due.set(trigger, due);
      this.pump();
    }
    return due.promise.then((bytes) => new Blob([bytes]).stream());
  }

  /** Where the play head is. By hand, nobody waits for what was asked for elsewhere; while it plays, for what is behind. */
  look(trigger, playing) {
    this.head = this.place(trigger);
    for (const [other, due] of this.due) {
      if (other === trigger || (playing && (other > trigger || this.flying.has(other)))) continue;
      this.due.delete(other);
      due.reject(new DOMException("another frame set is wanted", "AbortError"));
    }
    if (!playing && !this.kept.has(trigger)) {
      for (const [other, flight] of this.flying) if (other !== trigger) flight.abort();
    }
    this.pump();
  }

  /** The place of a trigger, or of the next one that has a cloud. */
  place(trigger) {
    const exact = this.places.get(trigger);
    if (exact !== undefined) return exact;
    const after = this.triggers.findIndex((other) => other > trigger);
    return after < 0 ? this.triggers.length - 1 : after;
  }

  pump() {
    while (this.flying.size < FLYING) {
      const trigger = this.next();
      if (trigger === undefined) return;
      this.fly(trigger);
    }
  }

  next() {
    for (const trigger of this.due.keys()) if (!this.flying.has(trigger)) return trigger;
    if (document.hidden || this.due.size) return undefined;
    const mean = this.kept.size ? this.bytes / this.kept.size : 0;
    const room = mean ? Math.floor(PACKED_BYTES / mean) - FLYING : FLYING;
    const begin = Math.max(0, Math.min(this.head - Math.floor(BEFORE * room), this.triggers.length - room));
    const end = Math.min(this.triggers.length, begin + room);
    const missing = (from, to) => {
      for (let place = from; place < to; place++) {
        const trigger = this.triggers[place];
        if (!this.kept.has(trigger) && !this.flying.has(trigger) && !this.failed.has(trigger)) return trigger;
      }
      return undefined;
    };
    return missing(this.head, end) ?? missing(begin, this.head);
  }

  async fly(trigger) {
    const flight = new AbortController();
    this.flying.set(trigger, flight);
    try {
      const bytes = await persist(() => node.frameSet(peer, session, trigger, flight.signal), flight.signal);
      this.keep(trigger, bytes);
      this.due.get(trigger)?.resolve(bytes);
      this.due.delete(trigger);
    } catch (error) {
      if (!flight.signal.aborted) {
        this.failed.add(trigger);
        this.due.get(trigger)?.reject(error);
        this.due.delete(trigger);
      }
    }
    this.flying.delete(trigger);
    this.onKept();
    this.pump();
  }

  /** What lies farthest from the play head goes first. */
  keep(trigger, bytes) {
    this.kept.set(trigger, bytes);
    this.bytes += bytes.byteLength;
    while (this.bytes > PACKED_BYTES) {
      const away = (other) => {
        const by = this.places.get(other) - this.head;
        return by < 0 ? -by / BEFORE : by / (1 - BEFORE);
      };
      const farthest = [...this.kept.keys()].reduce((far, other) => (away(other) > away(far) ? other : far));
      this.bytes -= this.kept.get(farthest).byteLength;
      this.kept.delete(farthest);
    }
  }
}

async function begin() {
  text($("title"), session || t("play-no-name"));
  document.title = `${session} - fourdbody`;
  if (!session) return;
  try {
    const source = new NodeSource(await persist(() => node.frameSets(peer, session)));
    const player = new Player($("player"), source, { t, number });
    source.onKept = () => {
      $("player").dataset.kept = String(source.kept.size);
      text(player.note, t("play-here", { kept: source.kept.size, n: source.triggers.length, mib: Math.round(source.bytes / 2 ** 20) }));
    };
  } catch (error) {
    text($("player-state"), t("play-cannot", { why: error.message }));
  }
}

begin();
