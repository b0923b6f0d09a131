/** Dates and times of day at a fixed offset from UTC, as URLs and queries have them. */

const ISO = /^(\d{4}-\d\d-\d\d)T([01]\d|2[0-3]):([0-5]\d)(?::\d\d(?:\.\d+)?)?(Z|[+-]\d\d:\d\d)$/;

export interface Moment {
  readonly date: string;
  readonly minutes: number;
  readonly offset: string;
}

export const DAY_MINUTES = 24 * 60;

const two = (value: number) => String(value).padStart(2, '0');

/** ISO 8601 text with an offset, to its parts; null if it is none. Seconds are dropped: the page has no field for them. */
export function parseMoment(text: string | undefined): Moment | null {
  const [, date, hours, minutes, offset] = ISO.exec(text ?? '') ?? [];
  if (!date || !hours || !minutes || !offset || !isDate(date)) return null;
  return { date, minutes: Number(hours) * 60 + Number(minutes), offset: offset === 'Z' ? '+00:00' : offset };
}

export function formatMoment({ date, minutes, offset }: Moment): string {
  return `${date}T${clockText(minutes)}:00${offset}`;
}

/** 17:45 */
export function clockText(minutes: number): string {
  return `${two(Math.floor(minutes / 60))}:${two(Math.floor(minutes) % 60)}`;
}

/** The offset of a time zone's clock at an instant: +02:00 of Europe/Oslo in summer. Null where the browser does not know the zone. */
export function offsetIn(zone: string, instant: Date): string | null {
  try {
    const parts = new Intl.DateTimeFormat('en-GB', { timeZone: zone, timeZoneName: 'longOffset' }).formatToParts(instant);
    const name = parts.find(({ type }) => type === 'timeZoneName')?.value ?? '';
    return /^GMT([+-]\d\d:\d\d)/.exec(name)?.[1] ?? (name === 'GMT' ? '+00:00' : null);
  } catch {
    return null;
  }
}

/**
 * A moment on another date by the same clock: where that is the clock of the place's time zone, its offset is that of the date.
 * An offset that somebody chose stays.
 */
export function onDate(moment: Moment, date: string, zone: string | null): Moment {
  const offset = (day: string) => zone && offsetIn(zone, new Date(`${day}T${clockText(moment.minutes)}:00${moment.offset}`));
  const kept = offset(moment.date) === moment.offset;
  return { ...moment, date, offset: (kept && offset(date)) || moment.offset };
}

/** The offset of the sun's own clock at a longitude in degrees, to the hour. */
export function offsetAt(longitude: number): string {
  const hours = Math.round(longitude / 15);
  return `${hours < 0 ? '-' : '+'}${two(Math.abs(hours))}:00`;
}

/** An offset in minutes: -240 of "-04:00". */
export function offsetMinutes(offset: string): number {
  const [hours = 0, minutes = 0] = offset.slice(1).split(':').map(Number);
  return (offset.startsWith('-') ? -1 : 1) * (hours * 60 + minutes);
}

/** Minutes since the midnight that begins a date by the clock of an offset: of an instant the service tells. */
export function minutesOfDay(instant: string, { date, offset }: Pick<Moment, 'date' | 'offset'>): number {
  return (Date.parse(instant) - Date.parse(`${date}T00:00:00${offset}`)) / 60_000;
}

/** Whether a text is a date of the calendar, as 2024-06-21. */
export function isDate(text: string): boolean {
  const read = Date.parse(`${text}T00:00:00Z`);
  // The 31st of a shorter month is read as a day of the next.
  return /^\d{4}-\d\d-\d\d$/.test(text) && !Number.isNaN(read) && new Date(read).toISOString().startsWith(text);
}

export function dayOfYear(date: string): number {
  return Math.round((Date.parse(date) - Date.parse(`${date.slice(0, 4)}-01-01`)) / 86_400_000) + 1;
}

export function dateOfYear(year: number, day: number): string {
  return new Date(Date.UTC(year, 0, day)).toISOString().slice(0, 10);
}

export function daysInYear(year: number): number {
  return dayOfYear(`${year}-12-31`);
}

/** 21 October 2024 */
export function dateText(date: string, month: 'long' | 'short' = 'long'): string {
  return new Date(`${date}T00:00:00Z`).toLocaleDateString('en-GB', { day: 'numeric', month, year: 'numeric', timeZone: 'UTC' });
}

/** Every offset that a clock on earth keeps, west to east. */
export const OFFSETS: readonly string[] = [
  '-12:00', '-11:00', '-10:00', '-09:30', '-09:00', '-08:00', '-07:00', '-06:00', '-05:00', '-04:00', '-03:30', '-03:00',
  '-02:30', '-02:00', '-01:00', '+00:00', '+01:00', '+02:00', '+03:00', '+03:30', '+04:00', '+04:30', '+05:00', '+05:30',
  '+05:45', '+06:00', '+06:30', '+07:00', '+08:00', '+08:45', '+09:00', '+09:30', '+10:00', '+10:30', '+11:00', '+12:00',
  '+12:45', '+13:00', '+13:45', '+14:00',
];
