// A session's clouds one after another: played at a part of their speed, scrubbed by hand, measured between two points.
// In the page of `fourdbody report --play` the frame sets stand in the page; in the console's player the node makes them.
// A source of them has `described`, as the node's API describes a sequence, and gives packed points (src/play/packed.rs).

import { CloudView } from "./cloud-view.js";

/** The player's words, where the page that it is in gives it no others: words-en.js has the same. */
const ENGLISH_WORDS = {
  "player-play": "Play",
  "player-pause": "Pause",
  "player-canvas": "point cloud: arrow keys, plus and minus turn and move it; space plays, comma and full stop step; click two points to measure",
  "player-place": "frame set",
  "player-speed": "speed",
  "player-colour": "colour",
  "player-intensity": "intensity",
  "player-normals": "normals",
  "player-uncertainty": "uncertainty",
  "player-uncertainty-not": "uncertainty (not known)",
  "player-points": "At most {points} points of each frame set, in tenths of a millimetre. Click two points for their distance.",
  "player-at": "trigger {trigger}, {seconds} s",
  "player-at-none": "trigger {trigger}, {seconds} s: no cloud ({why})",
  "player-point": "({x}, {y}, {z}) mm at trigger {trigger}",
  "player-from": "from {a}",
  "player-between": "{mm} mm between {a} and {b}",
};

/** The same as in words.js. */
const english = {
  t: (key, values = {}) => ENGLISH_WORDS[key].replace(/\{(\w+)\}/g, (_, name) => String(values[name])),
  number: (value, digits) => value.toFixed(digits),
};

const PACKED_POINT = 12;
/** Unpacked points that are kept, bytes, and how many frame sets are unpacked before they are due. */
const UNPACKED_BYTES = 96 << 20;
const AHEAD = 6;

/** Points as CloudView takes them, of one frame set: a stream of deflated planes of bytes. */
async function unpacked(packed) {
  const stream = packed.pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = Math.floor(planes.length / PACKED_POINT);
  const points = new Uint8Array(count * PACKED_POINT);
  const places = new DataView(points.buffer);
  for (let axis = 0; axis < 3; axis++) {
    let at = 0;
    for (let i = 0; i < count; i++) {
      // Each place is told from the one before.
      at = (at + planes[2 * axis * count + i] + 256 * planes[(2 * axis + 1) * count + i]) & 0xffff;
      places.setUint16(i * PACKED_POINT + 2 * axis, at, true);
    }
  }
  for (let byte = 6; byte < PACKED_POINT; byte++) {
    for (let i = 0; i < count; i++) points[i * PACKED_POINT + byte] = planes[byte * count + i];
  }
  return points.buffer;
}

/** The frame sets that stand in the page itself, as script elements behind the player. */
export class PageSource {
  constructor(described) {
    this.described = described;
    // The element is there before its text is whole: the next one is not.
    this.next = new Map();
    let before = null;
    for (const [first, last] of described.runs) {
      for (let trigger = first; trigger <= last; trigger++) {
        if (before !== null) this.next.set(before, trigger);
        before = trigger;
      }
    }
  }

  /** A promise of the packed points of a trigger; null while the page has not got so far. */
  packed(trigger) {
    const text = document.getElementById(`set-${trigger}`)?.textContent;
    const whole = document.readyState !== "loading" || document.getElementById(`set-${this.next.get(trigger)}`);
    return text && whole ? fetch(`data:application/octet-stream;base64,${text}`).then((answer) => answer.body) : null;
  }

  /** Where the play head is: everything is here. */
  look() {}
}

/** Plays what a source has, with all its controls in `root`. */
export class Player {
  constructor(root, source, { t, number } = english) {
    Object.assign(this, { t, number });
    this.root = root;
    this.source = source;
    const { runs, holes, seconds } = source.described;
    const all = [...runs.map(([first, last]) => ({ first, last })), ...holes].sort((a, b) => a.first - b.first);
    this.triggers = [];
    /** Why a place has no cloud. */
    this.why = new Map();
    for (const { first, last, why } of all) {
      for (let trigger = first; trigger <= last; trigger++) {
        if (why !== undefined) this.why.set(this.triggers.length, why);
        this.triggers.push(trigger);
      }
    }
    this.seconds = seconds;
    this.sets = new Map();
    this.bytes = 0;
    this.wanted = 0;
    this.shown = -1;
    this.playing = null;
    this.picked = [];
    this.build();
    this.button.addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    this.place.addEventListener("input", () => {
      this.pause();
      this.seek(Number(this.place.value));
    });
    this.speed.addEventListener("change", () => this.playing && this.play());
    this.colour.addEventListener("change", () => this.view.paint(this.colour.value));
    this.view.onPick = (point) => this.pick(point);
    this.view.onDraw = () => this.drawn();
    root.addEventListener("keydown", (event) => {
      const act = { " ": () => this.button.click(), ",": () => this.step(-1), ".": () => this.step(1) }[event.key];
      if (!act || (event.key === " " && event.target !== this.view.canvas)) return;
      event.preventDefault();
      act();
    });
    this.seek(0);
  }

  build() {
    const make = (tag, attributes = {}, ...children) => {
      const made = document.createElement(tag);
      for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
      made.append(...children);
      return made;
    };
    const choice = (of) => make("select", {}, ...of.map(([value, label]) => make("option", { value }, label)));
    const { t } = this;
    const canvas = make("canvas", { id: "played", tabindex: "0", "aria-label": t("player-canvas") });
    this.dots = [0, 1].map(() => make("i", { class: "picked", hidden: "" }));
    this.button = make("button", { type: "button" }, t("player-play"));
    this.place = make("input", { type: "range", min: "0", max: String(this.triggers.length - 1), value: "0", "aria-label": t("player-place") });
    this.holes = make("div", { class: "holes" });
    this.speed = choice([1, 2, 4, 8, 16].map((slow) => [String(1 / slow), `1/${slow}`]));
    this.speed.value = "0.25";
    this.colour = choice(["intensity", "normals", "uncertainty"].map((what) => [what, t(`player-${what}`)]));
    [this.told, this.distance, this.note] = [make("output"), make("output"), make("p", { class: "soft" })];
    const slider = make("div", { class: "slider" }, this.place, this.holes);
    this.root.append(
      make("div", { class: "stage" }, canvas, ...this.dots),
      make("div", { class: "controls" }, this.button, slider, make("label", {}, t("player-speed"), " ", this.speed), make("label", {}, t("player-colour"), " ", this.colour), this.told),
      make("p", {}, this.distance),
      make("p", { class: "soft" }, t("player-points", { points: this.source.described.points_each })),
      this.note,
    );
    this.view = new CloudView(canvas);
    this.drawHoles();
  }

  /** Below the slider, red where there is no cloud. */
  drawHoles() {
    const places = [...this.why.keys()].sort((a, b) => a - b);
    this.holes.replaceChildren();
    for (let i = 0; i < places.length; ) {
      let end = i + 1;
      while (places[end] === places[end - 1] + 1) end++;
      const hole = document.createElement("i");
      const share = (number) => `${(100 * number) / this.triggers.length}%`;
      [hole.style.left, hole.style.width] = [share(places[i]), share(end - i)];
      this.holes.append(hole);
      i = end;
    }
  }

  /** A promise of the points of a frame set, null where it has none; null while the source has not got so far. */
  get(place) {
    const known = this.sets.get(place);
    if (known) {
      this.sets.delete(place);
      this.sets.set(place, known);
      return known;
    }
    if (this.why.has(place)) return Promise.resolve(null);
    const packed = this.source.packed(this.triggers[place]);
    if (!packed) return null;
    const found = packed.then(unpacked).then(
      (points) => {
        this.bytes += points.byteLength;
        found.points = points;
        this.forget();
        return points;
      },
      (error) => {
        this.sets.delete(place);
        // What was left for something else comes again when it is asked for.
        if (error.name === "AbortError") throw error;
        this.why.set(place, error.message);
        this.drawHoles();
        return null;
      },
    );
    // Who asked ahead does not wait for it.
    found.catch(() => {});
    this.sets.set(place, found);
    return found;
  }

  /** What was asked for longest ago goes first. */
  forget() {
    for (const [place, set] of this.sets) {
      if (this.bytes <= UNPACKED_BYTES) return;
      if (!set.points) continue;
      this.bytes -= set.points.byteLength;
      this.sets.delete(place);
    }
  }

  /** Shows a frame set as soon as it is unpacked, unless another one is wanted by then; while it plays, what comes late is shown
   * all the same, as long as nothing later is. */
  async seek(place) {
    const asked = performance.now();
    this.wanted = place;
    this.source.look(this.triggers[place], Boolean(this.playing));
    const set = this.get(place);
    if (!set) {
      setTimeout(() => this.wanted === place && this.shown !== place && this.seek(place), 50);
      return;
    }
    let points;
    try {
      points = await set;
    } catch {
      return;
    }
    const late = this.playing && place > this.shown && place < this.wanted;
    if (this.wanted !== place && !late) return;
    this.show(place, points);
    this.asked = asked;
  }

  show(place, points) {
    this.shown = place;
    this.view.show(points ? [points] : [], Boolean(this.centred));
    this.centred ||= Boolean(points);
    this.place.value = String(place);
    const [trigger, seconds] = [this.triggers[place], this.seconds[place]];
    const at = { trigger: String(trigger), seconds: this.number(seconds, 3), why: this.why.get(place) };
    this.told.textContent = points ? this.t("player-at", at) : this.t("player-at-none", at);
    this.place.setAttribute("aria-valuetext", this.told.textContent);
    this.view.canvas.dataset.points = String(this.view.points);
    if (points) this.tellUncertainty(points);
    this.root.dataset.trigger = String(trigger);
  }

  /** Says whether this frame set has uncertainties: without them all is grey. */
  tellUncertainty(points) {
    const known = points.byteLength >= PACKED_POINT && new Uint8Array(points, PACKED_POINT - 1, 1)[0] > 0;
    const label = known ? this.t("player-uncertainty") : this.t("player-uncertainty-not");
    const option = this.colour.options[2];
    if (option.textContent !== label) option.textContent = label;
  }

  step(by) {
    this.pause();
    this.seek(Math.min(this.triggers.length - 1, Math.max(0, this.wanted + by)));
  }

  pause() {
    this.playing = null;
    this.button.textContent = this.t("player-play");
  }

  /** From where it is, or from the beginning at the end. */
  play() {
    if (this.wanted + 1 >= this.triggers.length) this.seek(0);
    const run = { from: this.seconds[this.wanted], since: performance.now() };
    this.playing = run;
    this.button.textContent = this.t("player-pause");
    const tick = (now) => {
      if (this.playing !== run) return;
      const due = run.from + (Math.max(0, now - run.since) / 1000) * Number(this.speed.value);
      const before = this.wanted;
      let place = before;
      while (place + 1 < this.triggers.length && this.seconds[place + 1] <= due) place++;
      // What comes next, at the pace that this machine keeps, is unpacked now.
      const pace = Math.max(1, place - before);
      for (let soon = 1; soon <= AHEAD && place + soon * pace < this.triggers.length; soon++) this.get(place + soon * pace);
      if (place !== before) this.seek(place);
      if (place + 1 < this.triggers.length) requestAnimationFrame(tick);
      else this.pause();
    };
    requestAnimationFrame(tick);
  }

  /** The first and the second of two points; a third begins anew. */
  pick(point) {
    if (!point) return;
    if (this.picked.length === 2) this.picked = [];
    this.picked.push({ point, trigger: this.triggers[this.shown] });
    const [a, b] = this.picked;
    const at = ({ point, trigger }) => {
      const [x, y, z] = point.map((metres) => this.number(1000 * metres, 1));
      return this.t("player-point", { x, y, z, trigger: String(trigger) });
    };
    const length = b && 1000 * Math.hypot(...a.point.map((x, axis) => x - b.point[axis]));
    this.distance.textContent = b ? this.t("player-between", { mm: this.number(length, 1), a: at(a), b: at(b) }) : this.t("player-from", { a: at(a) });
    this.view.draw();
  }

  /** What is shown has been drawn: notes how long it took from the begin of the page, and since it was asked for. */
  drawn() {
    if (this.asked !== undefined) {
      this.root.dataset.firstMs ??= performance.now().toFixed(1);
      this.root.dataset.seekMs = (performance.now() - this.asked).toFixed(1);
      this.root.dataset.drawn = this.root.dataset.trigger;
      this.asked = undefined;
    }
    this.drawPicked();
  }

  drawPicked() {
    this.dots.forEach((dot, i) => {
      const at = this.picked[i] && this.view.project(this.picked[i].point);
      dot.hidden = !at;
      if (at) dot.style.translate = `${at[0]}px ${at[1]}px`;
    });
  }
}
