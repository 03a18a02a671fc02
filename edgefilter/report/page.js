"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const boxes = [...document.querySelectorAll("#switches input")];
const key = (on) => on.map((x) => (x ? "1" : "0")).join("");
const chosen = () => boxes.map((box) => box.checked);
const variant = (on) => data.variants[key(on)];
const base = variant(boxes.map(() => false));
const round = (x) => (Math.abs(x) < 0.05 ? "0.0" : x.toFixed(1).replace("-", "−"));
const db = (x) => `${round(x)} dB`;

function put(parent, kind, style = {}, text = "") {
  const element = document.createElement("div");
  element.className = kind;
  element.textContent = text;
  for (const [name, value] of Object.entries(style)) element.style[name] = typeof value === "number" ? `${value}%` : value;
  return parent.appendChild(element);
}

function niceTop(value) {
  const step = [0.5, 1, 2, 5, 10, 20].find((s) => value / s <= 5) ?? 50;
  return { step, top: Math.max(step, Math.ceil((value * 1.02) / step) * step) };
}

function axis(frame, { step, top }, unit = "") {
  const plot = put(frame, "plot");
  for (let at = 0; at <= top + 1e-9; at += step) {
    put(frame, "tick", { bottom: (100 * at) / top }, `${+at.toFixed(2)}${unit}`);
    if (at > 0) put(plot, "grid", { bottom: (100 * at) / top });
  }
  return plot;
}

/* The error budget: the profile's error, a falling step for each effect, what is left. */
const stairs = document.getElementById("staircase");
const stairScale = niceTop(Math.max(1, ...Object.values(data.variants).map((v) => v.excess_db)) * 1.08);
let stairPlot = null;

function drawStaircase(on) {
  if (!stairPlot) stairPlot = axis(stairs, stairScale);
  stairPlot.replaceChildren(...stairPlot.querySelectorAll(".grid"));
  stairs.querySelectorAll(".step").forEach((old) => old.remove());
  const height = (x) => (100 * Math.max(x, 0)) / stairScale.top;
  const columns = boxes.length ? boxes.length + 2 : 1;
  stairs.style.maxWidth = `${columns * 12}rem`;
  const width = 100 / columns;
  const gap = Math.min(width * 0.14, 3);
  const column = (i) => ({ left: i * width + gap, width: width - 2 * gap });
  const label = (i, text) => put(stairs, "step", { left: i * width, width }, text);
  const amount = (i, level, text) => put(stairPlot, "amount", { left: (i + 0.5) * width, bottom: height(level) }, text);
  const total = (i, level, text) => {
    put(stairPlot, "stair left", { ...column(i), bottom: "0", height: height(level) });
    put(stairPlot, "stair never", { ...column(i), bottom: "0", height: height(Math.min(data.irreducible_db, level)) });
    amount(i, level, round(level));
    label(i, text);
  };
  total(0, base.excess_db, "the profile as it is");
  let level = base.excess_db;
  const told = [`Profile as it is: ${db(level)}`];
  boxes.forEach((box, i) => {
    const after = variant(on.map((x, k) => x && k <= i)).excess_db;
    const name = box.parentElement.textContent.trim();
    const low = Math.min(level, after);
    put(stairPlot, "tread", { left: (i + 1) * width - gap, width: 2 * gap, bottom: height(level) });
    if (on[i]) put(stairPlot, after > level ? "stair left" : "stair gone", { ...column(i + 1), bottom: height(low), height: height(Math.max(level, after)) - height(low) });
    else put(stairPlot, "tread", { left: (i + 1) * width, width, bottom: height(level) });
    amount(i + 1, Math.max(level, after), on[i] ? `${after > level ? "+" : "−"}${round(Math.abs(level - after))}` : "off");
    label(i + 1, name);
    told.push(on[i] ? `${name}: to ${db(after)}` : `${name}: off`);
    level = after;
  });
  if (boxes.length) {
    put(stairPlot, "tread", { left: (columns - 1) * width - gap, width: 2 * gap, bottom: height(level) });
    total(columns - 1, Math.max(level, data.irreducible_db || level), "left");
  }
  stairPlot.setAttribute("role", "img");
  stairPlot.setAttribute("aria-label", `Error budget over the noise floor. ${told.join("; ")}; irreducible: ${db(data.irreducible_db)}`);
}

/* Bar charts of where the error is. */
const LABEL_WIDTH = 34;
const kilo = (x) => (Math.abs(x) >= 1000 ? `${+(x / 1000).toFixed(1)}k` : `${+x.toFixed(1)}`);
const charts = [
  { id: "bands", name: "by frequency", unit: "Hz", scale: 1, even: true },
  { id: "times", name: "by time", unit: "s", scale: 1, even: false },
  { id: "levels", name: "by level", unit: "dBFS", scale: 1, even: true },
  { id: "lags", name: "by lag", unit: "ms", scale: 100, even: true },
];

function drawBars(chart, now) {
  const frame = document.querySelector(`#${chart.id} .frame`);
  const rows = now[chart.id].map((row) => [row[0], row[1], row[2] * chart.scale]);
  const was = base[chart.id].map((row) => [row[0], row[1], row[2] * chart.scale]);
  const all = Object.values(data.variants).flatMap((v) => v[chart.id].map((row) => row[2] * chart.scale));
  const scale = niceTop(Math.max(chart.scale === 1 ? 1 : 5, ...all));
  frame.replaceChildren();
  if (!rows.length) return void put(frame, "plot", {}, "too short to say");
  const plot = axis(frame, scale);
  const edges = [...new Set([...was, ...rows].flatMap((row) => [row[0], row[1]]))].sort((a, b) => a - b);
  const place = (x) => (chart.even ? (100 * edges.indexOf(x)) / (edges.length - 1) : (100 * x) / data.seconds);
  const bar = (row, kind) => {
    const left = place(row[0]);
    const width = place(row[1]) - left;
    const gap = Math.min(width * 0.12, 0.6);
    const height = (100 * Math.max(row[2], 0)) / scale.top;
    const element = put(plot, `bar ${kind}`, { left: left + gap, width: width - 2 * gap, height });
    element.title = `${kilo(row[0])} to ${kilo(row[1])} ${chart.unit}: ${round(row[2])} ${chart.scale === 1 ? "dB" : "%"}`;
  };
  rows.forEach((row) => bar(row, "now-bar"));
  if (boxes.length) was.forEach((row) => bar(row, "was-bar"));
  ticks(frame, chart.even ? edges : timeTicks(), place, chart.unit);
  const worst = rows.reduce((a, b) => (b[2] > a[2] ? b : a));
  plot.setAttribute("role", "img");
  plot.setAttribute("aria-label", `Error ${chart.name}; most at ${kilo(worst[0])} to ${kilo(worst[1])} ${chart.unit}: ${round(worst[2])}`);
}

/* Labels under the frame at the given values, thinned until they fit; the last one carries the unit. */
function ticks(frame, values, place, unit) {
  const every = Math.max(1, Math.ceil((values.length * LABEL_WIDTH) / frame.clientWidth));
  const shown = values.filter((_, i) => i % every === 0);
  shown.forEach((x, i) => {
    const label = put(frame, "under", { left: place(x) }, kilo(x));
    if (i === shown.length - 1) put(label, "unit", {}, unit);
  });
}

function timeTicks() {
  const { step } = niceTop(data.seconds);
  return Array.from({ length: Math.floor(data.seconds / step) + 1 }, (_, i) => i * step);
}

/* Spectrograms and players. */
function drawSpectrogram(id, what, words, from = 0) {
  const place = (s) => (100 * (s - from)) / (data.seconds - from);
  const figure = document.getElementById(id);
  const frame = figure.querySelector(".frame");
  if (!frame.firstChild) {
    const plot = put(frame, "plot");
    plot.append(document.createElement("img"));
    data.human.forEach(([start, end]) => {
      put(plot, "talk", { left: place(start), width: place(end) - place(start) }).title = "somebody talks";
    });
    const cursor = put(plot, "cursor", { left: 0, display: "none" });
    [0, 2, 4, 6, 8].forEach((khz) => put(frame, "tick", { bottom: (100 * khz) / 8 }, khz === 8 ? "8 kHz" : `${khz}`));
    const audio = figure.querySelector("audio");
    audio.addEventListener("timeupdate", () => {
      cursor.style.display = audio.currentTime > 0 ? "" : "none";
      cursor.style.left = `${place(from + audio.currentTime)}%`;
    });
  }
  frame.querySelectorAll(".under").forEach((old) => old.remove());
  ticks(frame, timeTicks().filter((s) => s >= from), place, "s");
  const image = figure.querySelector("img");
  image.src = data.media[what.picture];
  image.alt = `Spectrogram, ${words}`;
  load(figure.querySelector("audio"), data.media[what.sound]);
}

function load(audio, source) {
  if (audio.getAttribute("src") === source) return;
  const { currentTime, paused } = audio;
  audio.src = source;
  if (currentTime) audio.currentTime = currentTime;
  if (!paused) audio.play();
}

const louder = document.getElementById("louder");
const setVolume = () => (document.querySelector("#residual audio").volume = louder.checked ? 1 : 1 / data.louder);

/* Correlations of what is left with their bounds; hundredths along the lags and from -1 to 1 of the largest upwards. */
function drawCorrelogram(id, what) {
  const figure = document.getElementById(id);
  const frame = figure.querySelector(".frame");
  frame.replaceChildren();
  figure.querySelector(".says").replaceChildren(...(what?.says ?? []).map((text) => Object.assign(document.createElement("li"), { textContent: text })));
  if (!what) return void put(frame, "plot", {}, "too short to say");
  const { values, expected, bounds } = what;
  const top = 1.1 * Math.max(...values.map(Math.abs), ...bounds.map((b, i) => b + Math.abs(expected[i])));
  const x = (i) => ((100 * i) / (values.length - 1)).toFixed(2);
  const y = (v) => (50 - (50 * v) / top).toFixed(2);
  const line = (row) => row.map((v, i) => `${x(i)},${y(v)}`);
  const edge = (sign) => line(bounds.map((b, i) => expected[i] + sign * b));
  const plot = put(frame, "plot");
  const drawn = [["polygon", "band", [...edge(1), ...edge(-1).reverse()]], ["polyline", "trace", line(values)]];
  const marks = drawn.map(([kind, look, points]) => `<${kind} class="${look}" points="${points.join(" ")}"/>`);
  plot.innerHTML = `<svg viewBox="0 0 100 100" preserveAspectRatio="none" aria-hidden="true">${marks.join("")}</svg>`;
  const last = what.from_ms + what.step_ms * (values.length - 1);
  const place = (ms) => (100 * (ms - what.from_ms)) / (last - what.from_ms);
  if (what.from_ms < 0) put(plot, "zero", { left: place(0) });
  const short = (v) => +v.toPrecision(2);
  [-1, 0, 1].forEach((part) => put(frame, "tick", { bottom: 50 + 50 * (part / 1.1) }, `${short((part * top) / 1.1)}`.replace("-", "−")));
  const every = last > 50 ? 25 : 5;
  ticks(frame, Array.from({ length: Math.floor(last / every) - Math.ceil(what.from_ms / every) + 1 }, (_, i) => (i + Math.ceil(what.from_ms / every)) * every), place, "ms");
  plot.setAttribute("role", "img");
  plot.setAttribute("aria-label", what.says.join("; "));
}

/* Numbers for those who read tables. */
function drawTables(now) {
  const parent = document.getElementById("tables");
  parent.replaceChildren();
  charts.forEach((chart) => {
    const table = document.createElement("table");
    table.createCaption().textContent = `${chart.name[0].toUpperCase()}${chart.name.slice(1)}, ${chart.scale === 1 ? "dB" : "%"}`;
    now[chart.id].forEach(([low, high, value]) => {
      const row = table.insertRow();
      const head = row.appendChild(document.createElement("th"));
      head.scope = "row";
      head.textContent = `${kilo(low)} to ${kilo(high)} ${chart.unit}`;
      row.insertCell().textContent = round(value * chart.scale);
    });
    parent.append(table);
  });
}

function draw() {
  const on = chosen();
  const now = variant(on);
  document.getElementById("excess").textContent = db(now.excess_db);
  document.getElementById("silence").textContent = now.silence_db === null ? "" : `While the robot is silent: ${db(now.silence_db)}.`;
  drawStaircase(on);
  charts.forEach((chart) => drawBars(chart, now));
  drawSpectrogram("recording", data.recording, "recording");
  drawSpectrogram("prediction", now.prediction, "prediction");
  drawSpectrogram("residual", now.residual, `what is left, ${db(now.excess_db)} over the noise floor`);
  if (data.filtered) ["before", "after"].forEach((id) => drawSpectrogram(id, data.filtered[id], `${id} the effects, filtered`, data.filtered.from_s));
  drawCorrelogram("auto", now.correlations?.auto);
  drawCorrelogram("cross", now.correlations?.cross);
  drawTables(now);
}

/* Of many effects only the comparisons that leave out the last ones are there: then a switch moves those behind or before it too. */
boxes.forEach((box, i) =>
  box.addEventListener("change", () => {
    if (!variant(chosen())) boxes.forEach((other, k) => (other.checked = box.checked ? k <= i : k < i));
    draw();
  }),
);
louder.addEventListener("change", setVolume);
let drawnWidth = document.body.clientWidth;
addEventListener("resize", () => {
  if (document.body.clientWidth !== drawnWidth) draw();
  drawnWidth = document.body.clientWidth;
});
setVolume();
draw();
