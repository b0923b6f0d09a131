"use strict";

const data = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const all = (selector, within = document) => [...within.querySelectorAll(selector)];
const rowOf = (element) => Number(element.dataset.row);
const nameOf = (row) => $(`row-${row}`).querySelector("th").dataset.value;

/* ---- Selecting a row: in the plots, the table and the thumbnails alike ---- */

function choose(row) {
  for (const element of all("[data-row]")) {
    const marked = element.closest("figure.front, .thumbs figure") ?? element;
    marked.classList.toggle("chosen", rowOf(element) === row);
  }
  const line = $(`row-${row}`);
  const panel = $("chosen");
  const heading = document.createElement("h3");
  heading.append(...line.querySelector("summary").cloneNode(true).childNodes);
  const figures = document.createElement("dl");
  const titles = all("thead th", line.closest("table"));
  line.querySelectorAll("td.number").forEach((cell) => {
    const title = titles[cell.cellIndex].querySelectorAll("span");
    figures.append(pair(title[0].textContent, `${cell.textContent} ${title[1]?.textContent ?? ""}`));
  });
  const picture = document.querySelector(`.thumbs [data-row="${row}"] img`).cloneNode();
  const sides = document.createElement("p");
  sides.append(sideButton("Show left", "left", row), " ", sideButton("Show right", "right", row));
  panel.replaceChildren(heading, picture, sides, figures, line.querySelector(".particulars").cloneNode(true));
  panel.hidden = false;
  panel.scrollTop = 0;
}

function pair(term, value) {
  const both = document.createElement("div");
  const [dt, dd] = [document.createElement("dt"), document.createElement("dd")];
  dt.textContent = term;
  dd.textContent = value;
  both.append(dt, dd);
  return both;
}

function sideButton(text, side, row) {
  const button = document.createElement("button");
  button.type = "button";
  button.textContent = text;
  button.addEventListener("click", () => {
    $(side).value = row;
    $(side).dispatchEvent(new Event("change"));
    $("viewer").scrollIntoView({ block: "nearest" });
  });
  return button;
}

for (const link of all("a[data-row]")) {
  link.addEventListener("click", (event) => {
    event.preventDefault();
    choose(rowOf(link));
  });
}
for (const line of all("tbody tr")) {
  line.addEventListener("click", (event) => {
    if (!event.target.closest(".particulars")) choose(rowOf(line));
  });
}

/* ---- Names of points, on hover and on focus ---- */

const tip = document.createElement("div");
tip.id = "tip";
tip.hidden = true;
document.body.append(tip);

for (const point of all(".point")) {
  point.querySelector("title").remove(); // said by the tip, and to screen readers by the label
  const show = () => {
    const box = point.getBoundingClientRect();
    tip.textContent = point.getAttribute("aria-label");
    tip.hidden = false;
    const left = Math.min(box.right + 6, document.documentElement.clientWidth - tip.offsetWidth - 8);
    tip.style.left = `${window.scrollX + left}px`;
    tip.style.top = `${window.scrollY + box.top - tip.offsetHeight - 4}px`;
  };
  const hide = () => (tip.hidden = true);
  point.addEventListener("pointerenter", show);
  point.addEventListener("focus", show);
  point.addEventListener("pointerleave", hide);
  point.addEventListener("blur", hide);
}

/* ---- Sorting the table ---- */

const words = new Intl.Collator("en", { numeric: true });

function compareBy(column, sign) {
  return (one, other) => {
    const [a, b] = [one, other].map((line) => line.cells[column].dataset.value);
    const order = Number.isNaN(Number(a)) ? words.compare(a, b) : Number(a) - Number(b);
    return sign * order;
  };
}

for (const heading of all("thead th")) {
  const button = document.createElement("button");
  button.type = "button";
  button.append(...(heading.children.length ? heading.childNodes : [wrapped(heading)]));
  heading.replaceChildren(button);
  button.addEventListener("click", () => {
    const down = heading.getAttribute("aria-sort") === "ascending";
    all("thead th").forEach((other) => other.removeAttribute("aria-sort"));
    heading.setAttribute("aria-sort", down ? "descending" : "ascending");
    const body = heading.closest("table").tBodies[0];
    body.append(...[...body.rows].sort(compareBy(heading.cellIndex, down ? -1 : 1)));
  });
}

function wrapped(heading) {
  const span = document.createElement("span");
  span.textContent = heading.textContent;
  return span;
}

/* ---- Two pictures and a divider ---- */

const ERRORS = { 1: [214, 30, 30], 2: [30, 70, 214] };
const known = new Map(data.palette.map(([r, g, b], index) => [(r << 16) | (g << 8) | b, index]));
const decoded = new Map();
let ground = null;
let scale = null; // null: fitted to the pane
let share = 0.5;

async function pixelsOf(source) {
  const image = new Image();
  image.src = source;
  await image.decode();
  const canvas = new OffscreenCanvas(data.cols, data.rows);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  return context.getImageData(0, 0, data.cols, data.rows).data;
}

/* A colour that a browser has changed, as some do against fingerprinting, counts as the nearest of the palette. */
function nearest(r, g, b) {
  const distance = (index) => data.palette[index].reduce((sum, value, k) => sum + (value - [r, g, b][k]) ** 2, 0);
  return data.palette.reduce((best, _, index) => (distance(index) < distance(best) ? index : best), 0);
}

async function indexesOf(row) {
  if (!decoded.has(row)) {
    const pixels = await pixelsOf(document.querySelector(`.thumbs [data-row="${row}"] img`).src);
    const indexes = new Uint8Array(data.rows * data.cols);
    for (let k = 0, p = 0; k < indexes.length; k += 1, p += 4) {
      const key = (pixels[p] << 16) | (pixels[p + 1] << 8) | pixels[p + 2];
      if (!known.has(key)) known.set(key, nearest(pixels[p], pixels[p + 1], pixels[p + 2]));
      indexes[k] = known.get(key);
    }
    decoded.set(row, indexes);
  }
  return decoded.get(row);
}

async function paint(canvas, row, mode) {
  ground ??= await pixelsOf(data.ground);
  const indexes = await indexesOf(row);
  const picture = new ImageData(data.cols, data.rows);
  const out = picture.data;
  for (let k = 0, p = 0; k < indexes.length; k += 1, p += 4) {
    const lit = (indexes[k] % data.levels) / (data.levels - 1);
    const error = mode === "errors" && ERRORS[Math.floor(indexes[k] / data.levels)];
    if (error) {
      [out[p], out[p + 1], out[p + 2]] = error;
    } else if (mode === "errors") {
      const gray = (ground[p] + ground[p + 1] + ground[p + 2]) / 3;
      out[p] = out[p + 1] = out[p + 2] = (120 + gray / 2) * (0.72 + 0.28 * lit);
    } else {
      const light = 0.6 + 0.4 * lit; // about what the light of the sky leaves
      out[p] = ground[p] * light;
      out[p + 1] = ground[p + 1] * light;
      out[p + 2] = ground[p + 2] * light;
    }
    out[p + 3] = 255;
  }
  canvas.width = data.cols;
  canvas.height = data.rows;
  canvas.getContext("2d").putImageData(picture, 0, 0);
  canvas.setAttribute("aria-label", `${mode === "errors" ? "Errors" : "Shaded picture"} of ${nameOf(row)}`);
}

async function repaint() {
  const mode = document.querySelector('input[name="mode"]:checked').value;
  const [left, right] = [Number($("left").value), Number($("right").value)];
  $("left-name").textContent = nameOf(left);
  $("right-name").textContent = nameOf(right);
  await Promise.all([paint($("over"), left, mode), paint($("under"), right, mode)]);
}

function fitted() {
  return Math.min($("pane").clientWidth / data.cols, (0.78 * window.innerHeight) / data.rows);
}

function layOut() {
  const [pane, sheet] = [$("pane"), $("sheet")];
  const size = scale ?? fitted();
  sheet.style.width = `${data.cols * size}px`;
  sheet.style.height = `${data.rows * size}px`;
  sheet.classList.toggle("smooth", size < 1);
  $("zoom").textContent = `${Math.round(100 * size)} %`;
  pane.style.cursor = scale === null ? "ew-resize" : "";
  divide();
}

/* The divider stands at a share of what is seen of the pictures, however these are scrolled. */
function divide() {
  const [pane, sheet] = [$("pane"), $("sheet")];
  const first = sheet.offsetLeft - pane.scrollLeft;
  const from = Math.max(first, 0);
  const to = Math.min(first + sheet.offsetWidth, pane.clientWidth);
  const at = from + share * (to - from);
  $("divider").style.left = `${at}px`;
  $("over").style.clipPath = `inset(0 ${sheet.offsetWidth - (at - first)}px 0 0)`;
  $("split").value = 100 * share;
  return [from, to];
}

function divideAt(clientX) {
  const [from, to] = divide();
  share = Math.min(1, Math.max(0, (clientX - $("pane").getBoundingClientRect().left - from) / (to - from)));
  divide();
}

const ZOOMS = [0.25, 0.5, 1, 2, 4, 8, 16];

function zoom(way) {
  const pane = $("pane");
  const old = scale ?? fitted();
  const [x, y] = [(pane.scrollLeft + pane.clientWidth / 2) / old, (pane.scrollTop + pane.clientHeight / 2) / old];
  const fit = fitted();
  const steps = way > 0 ? ZOOMS.filter((step) => step > old * 1.001) : ZOOMS.filter((step) => step < old * 0.999 && step > fit);
  scale = way === 0 ? null : way > 0 ? (steps[0] ?? old) : (steps.at(-1) ?? null);
  layOut();
  const size = scale ?? fit;
  pane.scrollTo({ left: x * size - pane.clientWidth / 2, top: y * size - pane.clientHeight / 2, behavior: "instant" });
}

function dragging(element, moved) {
  element.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    element.setPointerCapture(event.pointerId);
    let [x, y] = [event.clientX, event.clientY];
    const move = (now) => {
      moved(now.clientX, now.clientX - x, now.clientY - y);
      [x, y] = [now.clientX, now.clientY];
    };
    element.addEventListener("pointermove", move);
    const end = () => element.removeEventListener("pointermove", move);
    element.addEventListener("lostpointercapture", end, { once: true });
  });
}

$("split").addEventListener("input", () => {
  share = Number($("split").value) / 100;
  divide();
});
dragging($("divider"), divideAt);
dragging($("pane"), (x, right, down) => (scale === null ? divideAt(x) : $("pane").scrollBy({ left: -right, top: -down, behavior: "instant" })));
$("pane").addEventListener("scroll", divide);
$("pane").addEventListener("keydown", (event) => {
  const way = { "+": 1, "=": 1, "-": -1, 0: 0 }[event.key];
  if (way !== undefined && !event.ctrlKey && !event.metaKey) zoom(way);
});
$("in").addEventListener("click", () => zoom(1));
$("out").addEventListener("click", () => zoom(-1));
$("fit").addEventListener("click", () => zoom(0));
for (const input of [$("left"), $("right"), ...all('input[name="mode"]')]) input.addEventListener("change", repaint);
window.addEventListener("resize", layOut);

$("viewer").hidden = false;
$("left").value = data.left;
$("right").value = data.right;
choose(data.right);
layOut();
repaint();
