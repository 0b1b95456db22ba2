// The page's words in the reader's language: a file of words a language, with the same keys. Sentences that nodes send
// come as they are, in English.

import { GERMAN } from "./words-de.js";
import { ENGLISH } from "./words-en.js";

/** The languages by their tags; the first one is for readers of none of them. */
const LANGUAGES = { en: ENGLISH, de: GERMAN };
const KEY = "fourdbody-language";

/** Attributes that name a word for their element, and the attribute that it goes to; null: its text. */
const PLACES = { "data-t": null, "data-t-title": "title", "data-t-placeholder": "placeholder", "data-t-label": "aria-label" };

const primary = (tag) => tag.split("-")[0];
let words = ENGLISH;
let now = "en";
/** How people of this language write numbers and dates, by their browser where it says more: `de-CH`. */
let region = "en";
let plural = null;
const formats = new Map();
const followers = [];

export const language = () => now;
export const languages = () => Object.keys(LANGUAGES);

/** The text of a key, with what stands in braces filled in. Of a word with several forms `n` selects the one. */
export function t(key, values = {}) {
  const said = words[key] ?? ENGLISH[key] ?? key;
  const form = typeof said === "string" ? said : (said[plural.select(values.n)] ?? said.other);
  return form.replace(/\{(\w+)\}/g, (_, name) => (typeof values[name] === "number" ? number(values[name]) : String(values[name])));
}

/** The text for a word of the API, such as the cause of a gap; the word itself where it is one that is not known here. */
export function wordOf(group, word) {
  const key = `${group}-${word}`;
  return Object.hasOwn(words, key) ? t(key) : String(word).replaceAll("_", " ");
}

/** A number for people, with exactly so many digits behind the point; without them with as many as it has, at most three. */
export function number(value, digits) {
  const [least, most] = digits === undefined ? [0, 3] : [digits, digits];
  const key = `${region} ${least} ${most}`;
  // To make a format takes far longer than to use it.
  if (!formats.has(key)) formats.set(key, new Intl.NumberFormat(region, { minimumFractionDigits: least, maximumFractionDigits: most, useGrouping: "min2" }));
  return formats.get(key).format(value);
}

/** Nanoseconds since 1970 as date and time of day. */
export const date = (ns) => new Date(ns / 1e6).toLocaleString(region, { dateStyle: "short", timeStyle: "short" });

/** Does something now, and again whenever another language is chosen. */
export function onLanguage(doing) {
  followers.push(doing);
  doing();
}

/** Chooses a language, for this browser and from now on. */
export function choose(tag) {
  localStorage.setItem(KEY, tag);
  speak();
}

function speak() {
  const known = (tag) => Object.hasOwn(LANGUAGES, primary(tag));
  const tag = [localStorage.getItem(KEY) ?? "", ...navigator.languages].find(known) ?? "en";
  now = primary(tag);
  words = LANGUAGES[now];
  region = navigator.languages.find((other) => primary(other) === now) ?? now;
  plural = new Intl.PluralRules(now);
  document.documentElement.lang = now;
  for (const [name, to] of Object.entries(PLACES)) {
    for (const element of document.querySelectorAll(`[${name}]`)) {
      const said = t(element.getAttribute(name));
      if (to) element.setAttribute(to, said);
      else element.textContent = said;
    }
  }
  for (const follow of followers) follow();
}

// The subject's screen follows what is chosen at the console, and stays on the whole screen.
addEventListener("storage", ({ key }) => key === KEY && speak());
speak();
