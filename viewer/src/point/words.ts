/** The report at a point in words: lit or in shadow, since when, until when, and the cause. */

import { type Light, type Span, daySpans, spanAt } from './day_spans';
import type { Caster, Day, Report } from './report';

export interface Answer {
  readonly light: Light;
  readonly title: string;
  /** Sentences; times in them are the service's own instants. */
  readonly sentences: readonly (readonly (string | Time)[])[];
}

/** An instant as the service tells it, shown to the minute. */
export interface Time {
  readonly instant: string;
}

const TITLES: Record<Light, string> = { lit: 'In the sun', shadow: 'In shadow', night: 'The sun is down' };
const WINDS = [
  'north', 'north-northeast', 'northeast', 'east-northeast', 'east', 'east-southeast', 'southeast', 'south-southeast',
  'south', 'south-southwest', 'southwest', 'west-southwest', 'west', 'west-northwest', 'northwest', 'north-northwest',
] as const;
const KINDS: Record<Caster['kind'], string> = { relief: 'a ridge', building: 'a building', mesh: 'a structure', forest: 'trees' };

/** 17:45 of an instant with an offset, by that offset's clock. */
export function clockOf(instant: string): string {
  return instant.slice(11, 16);
}

export function wind(azimuth: number): string {
  return WINDS[Math.round((((azimuth % 360) + 360) % 360) / 22.5) % 16] as string;
}

/** 12 m, 850 m, 2.4 km, 31 km */
export function distanceText(metres: number): string {
  if (metres < 10) return `${metres.toFixed(1)} m`;
  if (metres < 1000) return `${Math.round(metres)} m`;
  return `${metres < 10_000 ? (metres / 1000).toFixed(1) : Math.round(metres / 1000)} km`;
}

/** a ridge 2.4 km to the east, 3.1° high */
export function casterText({ kind, distance_m, azimuth, elevation }: Caster): string {
  return `${KINDS[kind]} ${distanceText(distance_m)} to the ${wind(azimuth)}, ${elevation.toFixed(1)}° high`;
}

/** 10 h 24 min, 5 min */
export function lengthText(minutes: number): string {
  const whole = Math.round(minutes);
  const [hours, rest] = [Math.floor(whole / 60), whole % 60];
  return [hours && `${hours} h`, (rest || !hours) && `${rest} min`].filter(Boolean).join(' ');
}

/** The answer for a minute of the report's day by the clock of an offset; null where the report has no day. */
export function answer(report: Report, minutes: number, offset: string): Answer | null {
  const { day, now } = report;
  if (!day) return null;
  const spans = daySpans(day, offset);
  const span = spanAt(spans, minutes);
  if (!span) return null;
  const told = now?.time && Math.abs(minuteOf(now.time, day, offset) - minutes) < 0.5 ? now : null;
  const sentences = { lit: litWords, shadow: shadowWords, night: nightWords }[span.light](span, spans, told?.by ?? span.by);
  return { light: span.light, title: TITLES[span.light], sentences: [...sentences, ...(day.remark ? [[`${capital(day.remark)}.`]] : [])] };
}

function minuteOf(instant: string, day: Day, offset: string): number {
  return (Date.parse(instant) - Date.parse(`${day.date}T00:00:00${offset}`)) / 60_000;
}

type Sentences = (string | Time)[][];

function litWords(span: Span, spans: readonly Span[]): Sentences {
  const index = spans.indexOf(span);
  const [before, after] = [spans[index - 1], spans[index + 1]];
  const since: Sentences[0] = span.beginsAt
    ? ['Since ', { instant: span.beginsAt }, before?.by ? `, when it cleared ${casterText(before.by)}.` : ', since it rose.']
    : ['Since midnight.'];
  const until: Sentences[0] = span.endsAt
    ? ['Until ', { instant: span.endsAt }, after?.by ? `, when it goes behind ${casterText(after.by)}.` : ', when it sets.']
    : ['Until midnight.'];
  return [since, until];
}

function shadowWords(span: Span, spans: readonly Span[], by: Caster | null): Sentences {
  const next = spans.slice(spans.indexOf(span) + 1).find(({ light }) => light === 'lit');
  return [
    ...(by ? [[`Of ${casterText(by)}.`]] : []),
    span.beginsAt ? ['Since ', { instant: span.beginsAt }, '.'] : ['Since midnight.'],
    span.endsAt
      ? ['Until ', { instant: span.endsAt }, next?.beginsAt === span.endsAt ? '.' : ', when the sun sets: no more sun today.']
      : ['Until midnight.'],
  ];
}

function nightWords(span: Span, spans: readonly Span[]): Sentences {
  const following = spans.slice(spans.indexOf(span) + 1);
  const lit = following.find(({ light }) => light === 'lit');
  return [
    ...(span.beginsAt ? [['Since ', { instant: span.beginsAt }, '.']] : []),
    ...(span.endsAt ? [['Until ', { instant: span.endsAt }, '.']] : []),
    ...(lit?.beginsAt && lit.beginsAt !== span.endsAt ? [['The first sun here comes at ', { instant: lit.beginsAt }, '.']] : []),
  ];
}

/** The intervals of direct sun, as rows to read. */
export function intervalRows(day: Day): { readonly from: Time; readonly to: Time; readonly length: string; readonly hides: string }[] {
  return day.sunlit.map(({ begin, end, after, before }) => ({
    from: { instant: begin },
    to: { instant: end },
    length: lengthText((Date.parse(end) - Date.parse(begin)) / 60_000),
    hides: [after && `comes from behind ${casterText(after)}`, before && `goes behind ${casterText(before)}`].filter(Boolean).join('; '),
  }));
}

export function capital(text: string): string {
  return text.slice(0, 1).toUpperCase() + text.slice(1);
}
