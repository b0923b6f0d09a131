/** The panel of the sun at a point, which a click on the map selects. */

import { Marker } from 'maplibre-gl';

import { html } from '../dom';
import { freeArea } from '../layout';
import { clockText, dateText } from '../moments';
import type { Panel, PanelContext } from '../panels';
import { handOver } from '../picking';
import { inWords, isAbort } from '../service';
import type { State } from '../state';
import { dayBar } from './day_bar';
import { daySpans } from './day_spans';
import { kindsSeen, polarSky } from './polar_sky';
import type { Report, Sky } from './report';
import { type Place, placeSearch } from './search';
import { type Answer, type Time, answer, capital, clockOf, intervalRows, lengthText } from './words';
import './point.css';

const PLACE = 'point';
const HEIGHT = 'point-height';
/** Without a change for so long, the exact answer is asked for: while the day plays, that of the day's intervals is shown. */
const CALM_MS = 250;
/** So far from the edge of what is seen a place has to be. */
const MARGIN_PX = 24;

/** Where is asked: degrees, and metres above the ground. */
interface Asked {
  readonly lon: number;
  readonly lat: number;
  readonly height: number;
}

interface Answered {
  readonly report: Report;
  readonly sky: Sky | null;
}

export function askedIn(own: State['own']): Asked | null {
  const [lon = NaN, lat = NaN] = (own[PLACE] ?? '').split(',').map(Number);
  const height = Number(own[HEIGHT] ?? 0);
  return own[PLACE] && Number.isFinite(lon) && Math.abs(lat) <= 90 ? { lon, lat, height: height >= 0 ? height : 0 } : null;
}

/** Asks at a place; the panel opens, and the map moves where the place would lie under it, or with `centred` in any case. */
function ask({ store, open, map }: PanelContext, { lng, lat }: Place, centred = false): void {
  store.setOwn({ [PLACE]: `${lng.toFixed(6)},${lat.toFixed(6)}` });
  open(pointPanel.id);
  const { x, y } = map.project([lng, lat]);
  const { left, top, right, bottom } = freeArea();
  if (!centred && x > left + MARGIN_PX && x < right - MARGIN_PX && y > top + MARGIN_PX && y < bottom - MARGIN_PX) return;
  const { clientWidth, clientHeight } = map.getContainer();
  map.easeTo({ center: [lng, lat], offset: [(left + right - clientWidth) / 2, (top + bottom - clientHeight) / 2] });
}

function start(context: PanelContext): void {
  const { map, store } = context;
  map.on('click', ({ lngLat }) => {
    if (!handOver(map, lngLat)) ask(context, lngLat);
  });
  const marker = new Marker({ element: html('div', { class: 'point-mark', 'aria-hidden': 'true' }) });
  let there = false;
  store.watch(({ own }) => askedIn(own), (asked) => {
    if (asked) marker.setLngLat([asked.lon, asked.lat]);
    if (asked && !there) marker.addTo(map);
    if (!asked && there) marker.remove();
    there = asked !== null;
  });
}

function mount(container: HTMLElement, context: PanelContext): () => void {
  const { store, map, service, announce } = context;
  const found = html('div', { class: 'point-answer', 'aria-busy': 'false' });
  const height = html('input', {
    type: 'number', min: 0, max: 1000, step: 'any', id: 'point-height', inputmode: 'decimal',
    onchange: () => store.setOwn({ [HEIGHT]: Number(height.value) > 0 ? String(Number(height.value)) : null }),
  });
  const clear = html('button', { type: 'button', class: 'plain', onclick: () => store.setOwn({ [PLACE]: null, [HEIGHT]: null }) }, 'Clear');
  const search = placeSearch(context, (place) => ask(context, place, true));
  container.append(
    search.element,
    found,
    html('label', { class: 'row', for: 'point-height' }, 'Metres above the ground', height),
    html('div', { class: 'buttons' },
      html('button', { type: 'button', onclick: () => ask(context, map.getCenter()) }, 'Ask at the middle of the map'), clear),
  );

  let loading = new AbortController();
  let timer: number | undefined;
  let held: { readonly key: string; readonly answered: Answered } | null = null;
  let said = '';

  const show = (state: State) => {
    if (!held) return;
    const told = held.answered.report.day ? answer(held.answered.report, state.minutes, state.offset) : null;
    found.replaceChildren(...answerParts(held.answered, state, told));
    if (told && told.title !== said) announce(`${told.title} at ${clockText(state.minutes)}.`);
    said = told?.title ?? '';
  };

  const fetchNow = async (state: State, asked: Asked) => {
    loading.abort();
    loading = new AbortController();
    const { signal } = loading;
    const query = { lon: asked.lon, lat: asked.lat, height: asked.height || null, ...momentQuery(state) };
    found.setAttribute('aria-busy', 'true');
    try {
      const report = await service.json<Report>(service.of(state.level, 'point', query), signal);
      const sky = report.elevation_m === null ? null : await service.json<Sky>(service.of(state.level, 'point/sun.json', query), signal);
      held = { key: keyOf(state), answered: { report, sky } };
      show(store.state);
    } catch (error) {
      if (isAbort(error)) return;
      held = null;
      found.replaceChildren(
        html('p', { class: 'fail' }, `No answer: ${inWords(error)}`),
        html('button', { type: 'button', onclick: () => void fetchNow(store.state, asked) }, 'Ask again'),
      );
    }
    if (!signal.aborted) found.setAttribute('aria-busy', 'false');
  };

  const end = store.watch(
    ({ level, date, minutes, offset, sunBy, own }) => [level, date, minutes, offset, sunBy, askedIn(own)] as const,
    (_, state) => {
      const asked = askedIn(state.own);
      clearTimeout(timer);
      clear.hidden = !asked;
      height.value = String(asked?.height ?? 0);
      if (!asked) {
        loading.abort();
        held = null;
        found.setAttribute('aria-busy', 'false');
        found.replaceChildren(html('p', { class: 'note' }, 'Click on the map: is it in the sun there, since when, until when, and what takes it away?'));
        return;
      }
      if (held?.key === keyOf(state)) show(state);
      else {
        held = null;
        found.replaceChildren(html('p', { class: 'note' }, 'Looking at the sky from there …'));
      }
      timer = window.setTimeout(() => void fetchNow(state, asked), held ? CALM_MS : 0);
    },
  );
  return () => {
    end();
    search.close();
    clearTimeout(timer);
    loading.abort();
  };
}

/** What the answer of a day hangs on: its moment moves within it. */
function keyOf({ level, date, offset, sunBy, own }: State): string {
  return JSON.stringify([level, date, offset, sunBy, askedIn(own)]);
}

/** Of a sun in a direction the service tells the day alone. */
function momentQuery(state: State): Record<string, string> {
  return state.sunBy === 'time'
    ? { time: `${state.date}T${clockText(state.minutes)}:00${state.offset}` }
    : { date: state.date, clock: state.offset };
}

function answerParts({ report, sky }: Answered, state: State, told: Answer | null): Node[] {
  if (report.elevation_m === null || !report.day) {
    return [html('p', { class: 'fail' }, `${capital(report.remark ?? 'the service knows nothing of this place')}.`)];
  }
  const { day } = report;
  const spans = daySpans(day, state.offset);
  const byTime = state.sunBy === 'time';
  const parts: Node[] = [];
  if (byTime && told) {
    parts.push(
      html('h2', { class: `light ${told.light}`, id: 'light-now' }, html('span', { class: 'dot', 'aria-hidden': 'true' }), told.title,
        html('small', {}, ` at ${clockText(state.minutes)}`)),
      html('p', { class: 'reasons' }, ...told.sentences.flatMap((sentence) => [...sentence.map(sentencePart), ' '])),
    );
  } else {
    parts.push(html('p', { class: 'note' }, 'The sun stands where you put it, at no time. This is the day of the date:'));
  }
  parts.push(
    dayBar(spans, state.minutes),
    html('p', { class: 'sums' }, html('strong', {}, lengthText(day.direct_h * 60)), ` of sun in ${lengthText(day.daylight_h * 60)} of daylight, ${dateText(day.date)}.`),
    intervalList(report),
  );
  if (sky) {
    const now = report.now && sameMinute(report, state) ? report.now : nearest(sky, state);
    parts.push(
      html('figure', { class: 'sky-figure' }, polarSky(sky, byTime ? now : null),
        html('figcaption', {}, ...kindsSeen(sky).map(({ kind, name }) => html('span', { class: `key ${kind}` }, name)),
          html('span', { class: 'key sunny' }, 'sun'), html('span', { class: 'key hidden' }, 'sun hidden'))),
    );
  }
  parts.push(html('p', { class: 'place' },
    `${report.lat?.toFixed(5)}, ${report.lon?.toFixed(5)}; ground ${report.elevation_m.toFixed(0)} m above sea`));
  return parts;
}

function sameMinute({ now }: Report, state: State): boolean {
  return Boolean(now?.time && now.time.slice(0, 16) === `${state.date}T${clockText(state.minutes)}`);
}

function nearest({ path }: Sky, state: State): { azimuth: number; altitude: number } | null {
  const at = Date.parse(`${state.date}T${clockText(state.minutes)}:00${state.offset}`);
  const found = path.find(({ time }) => Math.abs(Date.parse(time) - at) <= 150_000);
  return found ?? null;
}

function sentencePart(part: string | Time): Node | string {
  return typeof part === 'string' ? part : timeElement(part);
}

function timeElement({ instant }: Time): HTMLElement {
  return html('time', { datetime: instant }, clockOf(instant));
}

function intervalList({ day }: Report): HTMLElement {
  if (!day?.sunlit.length) return html('p', { class: 'note' }, 'No direct sun on this day.');
  return html('ol', { class: 'intervals', 'aria-label': 'Direct sun of the day' }, ...intervalRows(day).map(({ from, to, length, hides }) => html('li', {},
    timeElement(from), '–', timeElement(to), ` · ${length}`, hides && html('span', {}, capital(hides)))));
}

/** What of the address's parts is no place. */
function faults(own: State['own']): string[] {
  return own[PLACE] === undefined || askedIn(own) ? [] : [`${PLACE}=${own[PLACE]} is not understood: longitude,latitude`];
}

export const pointPanel: Panel = { id: 'point', title: 'Point', start, faults, mount };
