// The small things that every part of the console makes its elements with.

import { number } from "./words.js";

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
  if (seconds < 10) return `${number(seconds, 1)} s`;
  if (seconds < 90) return `${number(seconds, 0)} s`;
  return seconds < 5400 ? `${number(seconds / 60, 0)} min` : `${number(seconds / 3600, 1)} h`;
};
