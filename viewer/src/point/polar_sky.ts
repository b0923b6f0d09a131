/**
 * The sky over a point: north is up and east to the right, as on a map; the rim is the level horizon, the middle the zenith, and
 * altitudes are evenly spaced between.
 */

import { svg } from '../dom';
import type { Sky } from './report';
import { clockOf, wind } from './words';

const RADIUS = 100;
const MARGIN = 18;
/** From the rim inwards, what stands there: what is drawn later covers. */
const KINDS = ['forest', 'solids', 'relief'] as const;
const KIND_NAMES = { forest: 'trees', solids: 'buildings', relief: 'ground' } as const;
/** Hours nearer to one another than this have no number, in the drawing's units. */
const NUMBERED_APART = 16;

export interface Place {
  readonly azimuth: number;
  readonly altitude: number;
}

/** Where a direction of the sky lies in the drawing. */
export function placed({ azimuth, altitude }: Place): [number, number] {
  const away = RADIUS * (1 - Math.max(altitude, 0) / 90);
  const angle = (azimuth * Math.PI) / 180;
  return [away * Math.sin(angle), -away * Math.cos(angle)];
}

/** The ring between the rim and heights towards azimuths, as a path to be filled by the rule `evenodd`. */
export function ring(azimuth: readonly number[], height: readonly number[]): string {
  const inner = azimuth.map((each, n) => pair(placed({ azimuth: each, altitude: height[n] ?? 0 })));
  return `M0 ${-RADIUS}A${RADIUS} ${RADIUS} 0 1 1 0 ${RADIUS}A${RADIUS} ${RADIUS} 0 1 1 0 ${-RADIUS}ZM${inner.join('L')}Z`;
}

/** The sun's path cut where light and shadow change; a day that begins and ends with the sun up has it in two runs. */
export function runs(path: Sky['path'], step_ms = 300_000): { readonly lit: boolean; readonly points: [number, number][] }[] {
  const found: { lit: boolean; points: [number, number][] }[] = [];
  let last: Sky['path'][number] | undefined;
  for (const sun of path) {
    const joined = last && Date.parse(sun.time) - Date.parse(last.time) < 1.5 * step_ms;
    const open = found.at(-1);
    if (!open || !joined || open.lit !== sun.lit) {
      // The run before reaches to where the next begins, so that no gap is between them.
      if (open && joined) open.points.push(placed(sun));
      found.push({ lit: sun.lit, points: [placed(sun)] });
    } else open.points.push(placed(sun));
    last = sun;
  }
  return found;
}

/** The highest horizon, in words. */
export function skyWords({ horizon, path }: Sky): string {
  const heights = horizon.azimuth.map((_, n) => Math.max(...KINDS.map((kind) => horizon[kind][n] ?? 0)));
  const highest = heights.indexOf(Math.max(...heights));
  const sun = path.reduce<Sky['path'][number] | null>((top, each) => (!top || each.altitude > top.altitude ? each : top), null);
  return `Horizon: highest in the ${wind(horizon.azimuth[highest] ?? 0)} with ${(heights[highest] ?? 0).toFixed(1)}°. `
    + (sun ? `The sun climbs to ${sun.altitude.toFixed(1)}°.` : 'The sun does not rise.');
}

export function polarSky(sky: Sky, now: Place | null): SVGElement {
  const side = RADIUS + MARGIN;
  const drawing = svg('svg', { class: 'sky', viewBox: `${-side} ${-side} ${2 * side} ${2 * side}`, role: 'img', 'aria-label': skyWords(sky) });
  drawing.append(svg('circle', { r: RADIUS, class: 'air' }));
  for (const altitude of [30, 60]) drawing.append(svg('circle', { r: RADIUS * (1 - altitude / 90), class: 'grid' }));
  drawing.append(svg('path', { d: `M0 ${-RADIUS}V${RADIUS}M${-RADIUS} 0H${RADIUS}`, class: 'grid' }));
  for (const kind of KINDS) {
    if (sky.horizon[kind].some((height) => height > 0)) {
      drawing.append(svg('path', { d: ring(sky.horizon.azimuth, sky.horizon[kind]), 'fill-rule': 'evenodd', class: kind }));
    }
  }
  drawing.append(svg('circle', { r: RADIUS, class: 'rim' }));
  for (const { lit, points } of runs(sky.path)) {
    drawing.append(svg('polyline', { points: points.map(pair).join(' '), class: lit ? 'path lit' : 'path hidden' }));
  }
  drawing.append(...hourMarks(sky));
  for (const [name, x, y] of [['N', 0, -RADIUS - 9], ['E', RADIUS + 9, 0], ['S', 0, RADIUS + 9], ['W', -RADIUS - 9, 0]] as const) {
    drawing.append(svg('text', { x, y, class: 'wind' }, name));
  }
  if (now && now.altitude > 0) {
    const [cx, cy] = placed(now);
    drawing.append(svg('circle', { cx, cy, r: 6, class: 'sun' }));
  }
  return drawing;
}

function hourMarks({ path }: Sky): SVGElement[] {
  const marks: SVGElement[] = [];
  let numbered: [number, number] | null = null;
  for (const sun of path) {
    if (sun.time.slice(14, 16) !== '00') continue;
    const at = placed(sun);
    marks.push(svg('circle', { cx: at[0], cy: at[1], r: 1.8, class: 'hour' }));
    if (numbered && Math.hypot(at[0] - numbered[0], at[1] - numbered[1]) < NUMBERED_APART) continue;
    numbered = at;
    const [x, y] = placed({ azimuth: sun.azimuth, altitude: sun.altitude + (sun.altitude > 75 ? -9 : 9) });
    marks.push(svg('text', { x, y, class: 'hour' }, String(Number(clockOf(sun.time).slice(0, 2)))));
  }
  return marks;
}

/** Which kinds stand over the level horizon, to be told beside the drawing. */
export function kindsSeen({ horizon }: Sky): { readonly kind: string; readonly name: string }[] {
  return [...KINDS].reverse().filter((kind) => horizon[kind].some((height) => height > 0)).map((kind) => ({ kind, name: KIND_NAMES[kind] }));
}

function pair([x, y]: readonly [number, number]): string {
  return `${x.toFixed(2)} ${y.toFixed(2)}`;
}
