/** The page's state as the fragment of its URL (after "#"), so that a view can be bookmarked and shared. */

import { formatMoment, parseMoment } from './moments';
import { isRange } from './color_range';
import { FIRST_STATE, QUANTITIES, type State, THEMES, type View } from './state';

const KNOWN = new Set(['level', 'layer', 'style', 'time', 'azimuth', 'altitude', 'quantity', 'range', 'base', 'opacity', 'solid', 'theme', 'panel', 'view', 'map']);
const LAYER = /^[a-z][a-z0-9-]*$/;
const AZIMUTHS = [0, 360] as const;
const ALTITUDES = [-90, 90] as const;
const OPACITIES = [0, 1] as const;

/** The parts of an address by their names; those that are no parts as they stand. */
function partsOf(hash: string): { parts: Map<string, string>; broken: string[] } {
  const parts = new Map<string, string>();
  const broken: string[] = [];
  for (const part of hash.replace(/^#/, '').split('&').filter(Boolean)) {
    const cut = part.indexOf('=');
    try {
      if (cut < 1) throw new URIError(part);
      parts.set(part.slice(0, cut), decodeURIComponent(part.slice(cut + 1)));
    } catch {
      // A half escape in a hand-written address: the part is left out, the rest counts.
      broken.push(part);
    }
  }
  return { parts, broken };
}

/** What of an address means nothing by itself, in words: `readAddress` leaves it out. Names of panels are `own`. */
export function addressFaults(hash: string, own: readonly string[]): string[] {
  const { parts, broken } = partsOf(hash);
  const wrong = (name: string, isRight: (text: string) => boolean, right: string) => {
    const text = parts.get(name);
    return text === undefined || isRight(text) ? [] : [`${name}=${text} is not understood: ${right}`];
  };
  const range = ([least, most]: readonly [number, number]) => (text: string) => number(text, least, most) !== undefined;
  const among = (names: readonly string[]) => (text: string) => names.includes(text);
  return [
    ...broken.map((part) => `${part} is not understood: a part is name=value`),
    ...[...parts.keys()].filter((name) => !KNOWN.has(name) && !own.some((panel) => name === panel || name.startsWith(`${panel}-`)))
      .map((name) => `'${name}' means nothing`),
    ...wrong('time', (text) => parseMoment(text) !== null, 'a time is as 2024-06-21T12:00:00+02:00'),
    ...wrong('azimuth', range(AZIMUTHS), 'degrees from 0 to 360'),
    ...wrong('altitude', range(ALTITUDES), 'degrees from -90 to 90'),
    ...wrong('layer', (text) => LAYER.test(text), 'a layer is a word, as shadow'),
    ...wrong('quantity', among(QUANTITIES), QUANTITIES.join(', ')),
    ...wrong('range', isRange, 'day, fixed, or two numbers of hours from 0 to 24, as 6,10'),
    ...wrong('opacity', range(OPACITIES), 'a number from 0 to 1'),
    ...wrong('solid', among(['0', '1']), '0 or 1'),
    ...wrong('theme', among(THEMES), THEMES.join(', ')),
    ...wrong('map', (text) => readView(text) !== undefined, 'zoom/latitude/longitude'),
  ];
}

/** What an address says, without what it leaves open. Parts that mean nothing are as if they were not there. */
export function readAddress(hash: string): Partial<State> {
  const { parts } = partsOf(hash);
  const azimuth = number(parts.get('azimuth'), ...AZIMUTHS);
  const altitude = number(parts.get('altitude'), ...ALTITUDES);
  const moment = parseMoment(parts.get('time'));
  const own = Object.fromEntries([...parts].filter(([name]) => !KNOWN.has(name)));
  return defined({
    level: parts.get('level'),
    layer: LAYER.test(parts.get('layer') ?? '') ? parts.get('layer') : undefined,
    style: parts.get('style'),
    sunBy: moment ? 'time' : azimuth !== undefined || altitude !== undefined ? 'angles' : undefined,
    ...(moment ?? {}),
    azimuth,
    altitude,
    quantity: one(QUANTITIES, parts.get('quantity')),
    range: isRange(parts.get('range') ?? '') ? parts.get('range') : undefined,
    base: parts.get('base'),
    opacity: number(parts.get('opacity'), ...OPACITIES),
    solid: parts.has('solid') ? parts.get('solid') === '1' : undefined,
    theme: one(THEMES, parts.get('theme')),
    panel: parts.get('panel'),
    shot: parts.get('view'),
    view: readView(parts.get('map')),
    own: Object.keys(own).length ? own : undefined,
  });
}

/** The address of a state: what is as at first is left out, but for the level, the sun and the place. */
export function writeAddress(state: State): string {
  const rest = (name: 'layer' | 'quantity' | 'range' | 'base' | 'opacity' | 'theme' | 'panel') =>
    (state[name] === FIRST_STATE[name] ? undefined : String(state[name]));
  const parts: Record<string, string | undefined> = {
    level: state.level || undefined,
    layer: rest('layer'),
    style: state.style ?? undefined,
    ...(state.sunBy === 'time' && { time: formatMoment(state) }),
    ...(state.sunBy === 'angles' && { azimuth: String(state.azimuth), altitude: String(state.altitude) }),
    quantity: state.layer === 'sunhours' ? rest('quantity') : undefined,
    range: state.layer === 'sunhours' ? rest('range') : undefined,
    base: rest('base'),
    opacity: rest('opacity'),
    solid: state.solid ? '1' : undefined,
    theme: rest('theme'),
    panel: rest('panel'),
    view: state.shot ?? undefined,
    ...state.own,
    map: state.view ? writeView(state.view) : undefined,
  };
  const said = Object.entries(parts).filter((part): part is [string, string] => part[1] !== undefined);
  // ":", "/" and "," mean nothing in a fragment; left bare, the address stays readable. "+" stays escaped.
  return `#${said.map(([name, value]) => `${name}=${encodeURIComponent(value).replace(/%(3A|2F|2C)/g, decodeURIComponent)}`).join('&')}`;
}

function readView(text: string | undefined): View | undefined {
  const [zoom = NaN, lat = NaN, lon = NaN, bearing = 0, pitch = 0] = (text ?? '').split('/').map(Number);
  if (![zoom, lat, lon, bearing, pitch].every(Number.isFinite) || Math.abs(lat) > 90) return undefined;
  return { zoom, lat, lon, bearing, pitch };
}

function writeView({ zoom, lat, lon, bearing, pitch }: View): string {
  const turned = bearing || pitch ? `/${bearing.toFixed(1)}/${pitch.toFixed(1)}` : '';
  return `${zoom.toFixed(2)}/${lat.toFixed(5)}/${lon.toFixed(5)}${turned}`;
}

function number(text: string | undefined, least: number, most: number): number | undefined {
  const value = Number(text);
  return text && value >= least && value <= most ? value : undefined;
}

function one<Name extends string>(names: readonly Name[], text: string | undefined): Name | undefined {
  return names.find((name) => name === text);
}

function defined<Given extends object>(given: Given): { [Key in keyof Given]?: Exclude<Given[Key], undefined> } {
  return Object.fromEntries(Object.entries(given).filter(([, value]) => value !== undefined)) as never;
}
