/** The state as the part of the page's address after "#", so that what is seen can be bookmarked and sent. */

import { formatMoment, parseMoment } from './moments';
import { FIRST_STATE, LAYER_NAMES, QUANTITIES, type State, THEMES, type View } from './state';

const KNOWN = new Set(['level', 'layer', 'style', 'time', 'azimuth', 'altitude', 'quantity', 'base', 'opacity', 'solid', 'theme', 'panel', 'map']);

/** What an address says, without what it leaves open. Parts that mean nothing are as if they were not there. */
export function readAddress(hash: string): Partial<State> {
  const parts = new Map<string, string>();
  for (const part of hash.replace(/^#/, '').split('&')) {
    const cut = part.indexOf('=');
    try {
      if (cut > 0) parts.set(part.slice(0, cut), decodeURIComponent(part.slice(cut + 1)));
    } catch {
      // A half escape in a hand-written address: the part is left out, the rest counts.
    }
  }
  const azimuth = number(parts.get('azimuth'), 0, 360);
  const altitude = number(parts.get('altitude'), -90, 90);
  const moment = parseMoment(parts.get('time'));
  const own = Object.fromEntries([...parts].filter(([name]) => !KNOWN.has(name)));
  return defined({
    level: parts.get('level'),
    layer: one(LAYER_NAMES, parts.get('layer')),
    style: parts.get('style'),
    sunBy: moment ? 'time' : azimuth !== undefined || altitude !== undefined ? 'angles' : undefined,
    ...(moment ?? {}),
    azimuth,
    altitude,
    quantity: one(QUANTITIES, parts.get('quantity')),
    base: parts.get('base'),
    opacity: number(parts.get('opacity'), 0, 1),
    solid: parts.has('solid') ? parts.get('solid') === '1' : undefined,
    theme: one(THEMES, parts.get('theme')),
    panel: parts.get('panel'),
    view: readView(parts.get('map')),
    own: Object.keys(own).length ? own : undefined,
  });
}

/** The address of a state: what is as at first is left out, but for the level, the sun and the place. */
export function writeAddress(state: State): string {
  const rest = (name: 'layer' | 'quantity' | 'base' | 'opacity' | 'theme' | 'panel') =>
    (state[name] === FIRST_STATE[name] ? undefined : String(state[name]));
  const parts: Record<string, string | undefined> = {
    level: state.level || undefined,
    layer: rest('layer'),
    style: state.style ?? undefined,
    ...(state.sunBy === 'time'
      ? { time: formatMoment(state) }
      : { azimuth: String(state.azimuth), altitude: String(state.altitude) }),
    quantity: state.layer === 'sunhours' ? rest('quantity') : undefined,
    base: rest('base'),
    opacity: rest('opacity'),
    solid: state.solid ? '1' : undefined,
    theme: rest('theme'),
    panel: rest('panel'),
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
