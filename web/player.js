// A session's clouds one after another: played at a part of their speed, scrubbed by hand, measured between two points.
// Runs after cloud-view.js in the page of `fourdbody report --play`, which describes how its frame sets are packed.

const PACKED_POINT = 12;
/** Unpacked points that are kept, bytes, and how many frame sets are unpacked before they are due. */
const KEPT_BYTES = 128 << 20;
const AHEAD = 6;

/** Points as CloudView takes them, of the text of one frame set: base64 of deflated planes of bytes. */
async function unpacked(text) {
  const packed = await (await fetch(`data:application/octet-stream;base64,${text}`)).blob();
  const stream = packed.stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const count = planes.length / PACKED_POINT;
  const points = new Uint8Array(planes.length);
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

/** Plays the frame sets of a page. */
class Player {
  constructor(root, view) {
    this.root = root;
    this.view = view;
    this.triggers = root.dataset.triggers.split(",").map(Number);
    this.seconds = this.triggers.map((trigger) => trigger / Number(root.dataset.rate));
    this.sets = new Map();
    this.bytes = 0;
    this.wanted = 0;
    this.shown = -1;
    this.playing = null;
    this.picked = [];
    const find = (name) => root.querySelector(`[name=${name}]`);
    [this.button, this.place, this.speed, this.colour] = ["play", "place", "speed", "colour"].map(find);
    [this.told, this.distance] = root.querySelectorAll("output");
    this.button.addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    this.place.addEventListener("input", () => {
      this.pause();
      this.seek(Number(this.place.value));
    });
    this.speed.addEventListener("change", () => this.playing && this.play());
    this.colour.addEventListener("change", () => view.paint(this.colour.value));
    view.onPick = (point) => this.pick(point);
    view.onDraw = () => this.drawPicked();
    root.addEventListener("keydown", (event) => {
      const act = { " ": () => this.button.click(), ",": () => this.step(-1), ".": () => this.step(1) }[event.key];
      if (!act || (event.key === " " && event.target !== view.canvas)) return;
      event.preventDefault();
      act();
    });
    this.seek(0);
  }

  /** The points of a frame set; null while the page has not got so far. */
  get(place) {
    const known = this.sets.get(place);
    if (known) {
      this.sets.delete(place);
      this.sets.set(place, known);
      return known;
    }
    const text = document.getElementById(`set-${place}`)?.textContent;
    // The element is there before its text is whole: the next one is not.
    const whole = document.readyState !== "loading" || document.getElementById(`set-${place + 1}`);
    if (!text || !whole) return null;
    const found = unpacked(text).then((points) => {
      this.bytes += points.byteLength;
      found.points = points;
      this.forget();
      return points;
    });
    this.sets.set(place, found);
    return found;
  }

  /** What was asked for longest ago goes first. */
  forget() {
    for (const [place, set] of this.sets) {
      if (this.bytes <= KEPT_BYTES) return;
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
    const set = this.get(place);
    if (!set) {
      setTimeout(() => this.wanted === place && this.shown !== place && this.seek(place), 50);
      return;
    }
    const points = await set;
    const late = this.playing && place > this.shown && place < this.wanted;
    if (this.wanted !== place && !late) return;
    this.show(place, points);
    this.root.dataset.seekMs = (performance.now() - asked).toFixed(1);
  }

  show(place, points) {
    const first = this.shown < 0;
    this.shown = place;
    this.view.show([points], !first);
    this.place.value = String(place);
    const [trigger, seconds] = [this.triggers[place], this.seconds[place]];
    this.told.textContent = `trigger ${trigger}, ${seconds.toFixed(3)} s`;
    this.place.setAttribute("aria-valuetext", this.told.textContent);
    this.view.canvas.dataset.points = String(this.view.points);
    this.root.dataset.trigger = String(trigger);
  }

  step(by) {
    this.pause();
    this.seek(Math.min(this.triggers.length - 1, Math.max(0, this.wanted + by)));
  }

  pause() {
    this.playing = null;
    this.button.textContent = "Play";
  }

  /** From where it is, or from the beginning at the end. */
  play() {
    if (this.wanted + 1 >= this.triggers.length) this.seek(0);
    const run = { from: this.seconds[this.wanted], since: performance.now() };
    this.playing = run;
    this.button.textContent = "Pause";
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
    const at = ({ point, trigger }) => `(${point.map((x) => (1000 * x).toFixed(1)).join(", ")}) mm at trigger ${trigger}`;
    const length = b && 1000 * Math.hypot(...a.point.map((x, axis) => x - b.point[axis]));
    this.distance.textContent = b ? `${length.toFixed(1)} mm between ${at(a)} and ${at(b)}` : `from ${at(a)}`;
    this.view.draw();
  }

  drawPicked() {
    this.root.querySelectorAll(".picked").forEach((dot, i) => {
      const at = this.picked[i] && this.view.project(this.picked[i].point);
      dot.hidden = !at;
      if (at) dot.style.translate = `${at[0]}px ${at[1]}px`;
    });
  }
}
