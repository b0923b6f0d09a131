/** Parser of coordinates that a user types or pastes: degrees in the usual spellings, or metres of a CRS. */

export type Coordinates =
  | { readonly kind: 'degrees'; readonly lat: number; readonly lon: number }
  /** To the east and to the north, in the units of a projected CRS. */
  | { readonly kind: 'projected'; readonly x: number; readonly y: number };

type Axis = 'lat' | 'lon';

interface Angle {
  readonly value: number;
  /** By its letter; null without one. */
  readonly axis: Axis | null;
}

const NUMBER = String.raw`\d+(?:[.,]\d+)?`;
/** 47, 47.1, 47°, 47°06', 47°06'30.5" and 47 06 30, with or without a letter. "O" is east in German. */
const ANGLE = new RegExp(
  String.raw`^([NSEWO])?\s*([+-])?\s*(${NUMBER})\s*(?:°|d|\s)?\s*(?:(${NUMBER})\s*(?:'|m|\s)?\s*)?(?:(${NUMBER})\s*(?:"|s)?)?\s*([NSEWO])?$`, 'i',
);

/** What a text means; null if it is none. Degrees without letters are latitude and longitude, in this order. */
export function parseCoordinates(text: string): Coordinates | null {
  const plain = text.trim().replace(/[′’‘´]/g, "'").replace(/″|“|”|''/g, '"').replace(/[−–]/g, '-').replace(/º/g, '°').replace(/\s+/g, ' ');
  const halves = halvesOf(plain);
  if (!halves) return null;
  const angles = halves.map(parseAngle);
  const [first, second] = angles;
  if (!first || !second) return null;
  if (first.axis !== null && first.axis === second.axis) return null;
  const swapped = first.axis === 'lon' || second.axis === 'lat';
  const [lat, lon] = swapped ? [second.value, first.value] : [first.value, second.value];
  if (Math.abs(lat) <= 90 && Math.abs(lon) <= 180) return { kind: 'degrees', lat, lon };
  // A grid's coordinates are told to the east first; letters may say otherwise.
  if (/[°'"]/.test(plain) || halves.some((half) => /[SW]/i.test(half))) return null;
  return first.axis === 'lat' || second.axis === 'lon' ? { kind: 'projected', x: second.value, y: first.value } : { kind: 'projected', x: first.value, y: second.value };
}

/** The two coordinates of a text, without what lies between them. */
function halvesOf(text: string): [string, string] | null {
  const found = /^([^;]+);([^;]+)$/.exec(text)
    ?? /^([^,]+),([^,]+)$/.exec(text)
    // A comma before a space parts coordinates with decimal commas.
    ?? /^(.+?), (.+)$/.exec(text)
    ?? /^(.*?[NSEWO]) ?(?=[+-]?\d)(.+[NSEWO])$/i.exec(text)
    ?? /^([NSEWO].+?) ?(?=[NSEWO])(.+)$/i.exec(text)
    ?? /^(\S+) (\S+)$/.exec(text);
  const [, first, second] = found ?? [];
  return first && second ? [first.trim(), second.trim()] : null;
}

function parseAngle(text: string): Angle | null {
  const [, before, sign, whole, minutes, seconds, behind] = ANGLE.exec(text) ?? [];
  if (whole === undefined || (before && behind)) return null;
  const [degrees = NaN, minute = 0, second = 0] = [whole, minutes, seconds].map((part) => (part === undefined ? undefined : Number(part.replace(',', '.'))));
  if (!Number.isFinite(degrees) || minute >= 60 || second >= 60) return null;
  const letter = (before ?? behind ?? '').toUpperCase();
  const isNegative = (sign === '-') !== (letter === 'S' || letter === 'W');
  const axis = letter === '' ? null : 'NS'.includes(letter) ? 'lat' : 'lon';
  return { value: (isNegative ? -1 : 1) * (degrees + minute / 60 + second / 3600), axis };
}
