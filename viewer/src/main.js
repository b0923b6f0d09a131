import { readHash, writeHash } from './hash.js';
import { createMap } from './map.js';
import { showPlan } from './plan.js';
import { address, requestJson } from './service.js';
import { OFFSETS, formatTime, minutesOf, noonToday, parseTime, timeOf } from './suntime.js';
import './style.css'; // after MapLibre's, which it adjusts

const TMS = 'WebMercatorQuad';
const LAYERS = { color: 'Shaded relief', shadow: 'Shadows only' };
const CALM = 300; // ms without a change before a slider's value is drawn

const $ = (id) => document.getElementById(id);
const panel = $('panel');

let levels = [];
let map;
let show;
let tileZoom;
let loading = new AbortController();
let planning = new AbortController();
let planned = '';
let timer;

// --- the panel's fields ---------------------------------------------------------------------------------------------

function option(value, text = value) {
  return Object.assign(document.createElement('option'), { value, textContent: text });
}

function setTime(moment) {
  if (!OFFSETS.includes(moment.offset)) $('offset').append(option(moment.offset, `UTC${moment.offset}`));
  $('date').value = moment.date;
  $('time').value = moment.time;
  $('minutes').value = minutesOf(moment.time);
  $('offset').value = moment.offset;
}

function setAngles(azimuth, altitude) {
  $('azimuth').value = azimuth;
  $('altitude').value = altitude;
}

function setMode(mode) {
  panel.elements.mode.value = mode;
}

function setLayers(level, wanted) {
  const names = Object.keys(LAYERS).filter((name) => level.layers?.includes(name) ?? true);
  $('layers').replaceChildren(...names.map((name) => {
    const label = document.createElement('label');
    const input = Object.assign(document.createElement('input'), { type: 'radio', name: 'layer', value: name });
    input.checked = name === wanted;
    label.append(input, Object.assign(document.createElement('span'), { textContent: LAYERS[name] }));
    return label;
  }));
  if (!names.includes(wanted) && names.length) panel.elements.layer.value = names[0];
}

/** What follows from the fields: shown beside them, never read back. */
function refreshFields() {
  const byTime = panel.elements.mode.value === 'time';
  $('by-time').hidden = !byTime;
  $('by-angles').hidden = byTime;
  $('azimuth-value').value = `${$('azimuth').value}°`;
  $('altitude-value').value = `${$('altitude').value}°`;
  $('minutes').setAttribute('aria-valuetext', $('time').value);
}

/** The sun as the service's query wants it; null while a field is empty. */
function sunQuery() {
  if (panel.elements.mode.value === 'angles') return { azimuth: $('azimuth').value, altitude: $('altitude').value };
  if (!$('date').value || !$('time').value) return null;
  return { time: formatTime({ date: $('date').value, time: $('time').value, offset: $('offset').value }) };
}

function currentLevel() {
  return levels.find((level) => level.name === $('level').value);
}

/** Sets layer and sun from the address, and where it is silent from the level. */
function setFields(level, state) {
  setLayers(level, state.layer ?? 'color');
  const sun = level.sun ?? {};
  const [west, , east] = level.bounds;
  setTime(parseTime(state.time) ?? parseTime(sun.time) ?? noonToday((west + east) / 2));
  setAngles(state.azimuth ?? sun.azimuth ?? 315, state.altitude ?? sun.altitude ?? 30);
  const angles = state.time === undefined && (state.azimuth ?? (sun.time === undefined ? sun.azimuth : undefined)) !== undefined;
  setMode(angles ? 'angles' : 'time');
  refreshFields();
}

// --- what the panel says --------------------------------------------------------------------------------------------

function say(words, { failed = false } = {}) {
  $('status').hidden = !words;
  $('status').classList.toggle('failed', failed);
  $('status-words').textContent = words;
  $('again').hidden = !failed;
}

function sayProgress({ loading: waiting, failed, message }) {
  if (failed) say(`${failed === 1 ? 'A tile is' : `${failed} tiles are`} missing: ${message}`, { failed: true });
  else say(waiting ? 'Drawing …' : '');
}

/** The sky seen from below the zenith: azimuth around, altitude from the rim (horizon) to the middle. */
function saySun(sun) {
  const known = Number.isFinite(sun?.azimuth) && Number.isFinite(sun?.altitude);
  $('sun').hidden = !known;
  if (!known) return;
  const { azimuth, altitude } = sun;
  const radius = 16 * (1 - Math.max(0, altitude) / 90);
  const angle = (azimuth * Math.PI) / 180;
  $('sun-dot').setAttribute('cx', radius * Math.sin(angle));
  $('sun-dot').setAttribute('cy', -radius * Math.cos(angle));
  $('sun-dot').classList.toggle('down', altitude < 0);
  const lines = [`Azimuth ${azimuth.toFixed(1)}°`, `Altitude ${altitude.toFixed(1)}°${altitude < 0 ? ', below the horizon' : ''}`];
  $('sun-words').replaceChildren(...lines.map((textContent) => Object.assign(document.createElement('span'), { textContent })));
}

// --- drawing --------------------------------------------------------------------------------------------------------

function saveState() {
  const level = currentLevel();
  if (!level) return;
  const center = map.getCenter();
  writeHash({
    level: level.name,
    layer: panel.elements.layer?.value,
    ...sunQuery(),
    map: `${map.getZoom().toFixed(2)}/${center.lat.toFixed(5)}/${center.lng.toFixed(5)}`,
  });
}

/** Room for the panel, so that the level is not fitted behind it. */
function padding() {
  const wide = window.innerWidth > 640 && !$('settings').hidden;
  return { top: 24, bottom: 40, right: 24, left: wide ? panel.getBoundingClientRect().right + 24 : 24 };
}

function fit(level) {
  const [west, south, east, north] = level.bounds;
  map.fitBounds([[west, south], [east, north]], { padding: padding(), animate: false });
}

/** Asks for the plan of the tiles on screen and shows it: one for a level, a zoom and a sun. */
async function explain() {
  const level = currentLevel();
  const sun = sunQuery();
  if (!level?.bounds || !sun) return;
  const url = address(`levels/${encodeURIComponent(level.name)}/plan`, { zoom: tileZoom(level), ...sun });
  if (url === planned) return;
  planned = url;
  planning.abort();
  planning = new AbortController();
  $('plan').classList.add('old');
  try {
    showPlan($('plan'), await requestJson(url, planning.signal));
    $('plan').classList.remove('old');
  } catch (error) {
    if (error.name === 'AbortError') return;
    planned = '';
    $('plan').hidden = true; // what went wrong is said where the tiles' errors are
  }
}

/** Asks for the tiles of the present fields and shows them. */
async function draw() {
  clearTimeout(timer);
  const level = currentLevel();
  const sun = sunQuery();
  refreshFields();
  if (!level) return;
  if (!sun) {
    say('Give a date and a time.');
    return;
  }
  saveState();

  loading.abort();
  loading = new AbortController();
  const { signal } = loading;
  const url = address(`levels/${encodeURIComponent(level.name)}/${TMS}/tilejson.json`, { layer: panel.elements.layer.value, ...sun });
  say('Drawing …');
  try {
    const tilejson = await requestJson(url, signal);
    // Resolving escapes the braces of the template, which must stay.
    const tiles = tilejson.tiles.map((tile) => new URL(tile, url).href.replace(/%7B/gi, '{').replace(/%7D/gi, '}'));
    $('tiles').value = tiles[0];
    $('tilejson').href = url;
    saySun(tilejson.skugga?.sun);
    show(level.name, { ...tilejson, tiles });
    explain();
  } catch (error) {
    if (error.name !== 'AbortError') say(error.message, { failed: true });
  }
}

function drawSoon() {
  refreshFields();
  clearTimeout(timer);
  timer = setTimeout(draw, CALM);
}

/** Puts a level, and what the address says about it, on the screen. */
function open(level, state) {
  $('level').value = level.name;
  document.title = `${level.title ?? level.name} · Skugga`;
  setFields(level, state);
  const [zoom, lat, lng] = (state.map ?? '').split('/').map(Number);
  // The zoom limits of the level before would hold the new view back; `show` sets this level's.
  map.setMinZoom(0);
  map.setMaxZoom(22);
  if ([zoom, lat, lng].every(Number.isFinite) && Math.abs(lat) <= 90) map.jumpTo({ zoom, center: [lng, lat] });
  else fit(level);
  return draw();
}

function openFromAddress() {
  const state = readHash();
  const usable = levels.filter((level) => level.bounds);
  const level = usable.find((each) => each.name === state.level) ?? usable[0];
  if (!level) {
    say(levels.length ? 'No level here has a place on the earth, so there is no map to show.' : 'The service has no levels.');
    return;
  }
  // A view saved for a level that is not here says nothing about another.
  open(level, level.name === state.level || !state.level ? state : {});
}

// --- start ----------------------------------------------------------------------------------------------------------

function listen() {
  panel.addEventListener('submit', (event) => event.preventDefault());

  $('minutes').addEventListener('input', () => { $('time').value = timeOf(Number($('minutes').value)); });
  $('time').addEventListener('input', () => { if ($('time').value) $('minutes').value = minutesOf($('time').value); });
  $('level').addEventListener('change', () => open(currentLevel(), { layer: panel.elements.layer?.value }));
  // Events rise to the panel after the fields above have been set to agree.
  panel.addEventListener('input', (event) => {
    if (event.target.id === 'level' || event.target.readOnly) return;
    drawSoon();
  });

  $('tiles').addEventListener('focus', () => $('tiles').select());
  $('again').addEventListener('click', () => { if (levels.length) draw(); else start(); });
  $('toggle').addEventListener('click', () => {
    const hide = !$('settings').hidden;
    $('settings').hidden = hide;
    $('toggle').setAttribute('aria-expanded', String(!hide));
    $('toggle').textContent = hide ? 'Settings' : 'Hide';
  });
  window.addEventListener('hashchange', openFromAddress);
  map.on('moveend', () => { saveState(); explain(); });
}

async function start() {
  try {
    levels = await requestJson(address('levels'));
  } catch (error) {
    say(error.message, { failed: true });
    return;
  }
  $('level').replaceChildren(...levels.map((level) => {
    const item = option(level.name, level.title ?? level.name);
    item.disabled = !level.bounds;
    return item;
  }));
  openFromAddress();
}

$('offset').append(...OFFSETS.map((offset) => option(offset, `UTC${offset}`)));
try {
  ({ map, show, tileZoom } = createMap($('map'), sayProgress));
  listen();
  map.once('load', start);
} catch {
  say('This browser cannot draw the map: it has no WebGL 2.');
}
