// The small things that every part of the console makes its elements with.

export const $ = (id) => document.getElementById(id);

/** Sets a text, where it is another one: so nothing is selected away or read aloud twice. */
export const text = (element, value) => {
  if (element.textContent !== value) element.textContent = value;
};

export const make = (tag, attributes = {}, ...children) => {
  const element = Object.assign(document.createElement(tag), attributes);
  element.append(...children);
  return element;
};

/** A time span for people. */
export const span = (seconds) => {
  if (seconds < 10) return `${seconds.toFixed(1)} s`;
  if (seconds < 90) return `${seconds.toFixed(0)} s`;
  return seconds < 5400 ? `${(seconds / 60).toFixed(0)} min` : `${(seconds / 3600).toFixed(1)} h`;
};

/** `1 frame`, `2 frames`. */
export const count = (number, word) => `${number} ${word}${number === 1 ? "" : "s"}`;
