/** Times as the panel shows them: a date, a time of day in minutes, and an offset from UTC as "+02:00". */

const ISO = /^(\d{4}-\d\d-\d\d)T(\d\d:\d\d)(?::\d\d(?:\.\d+)?)?(Z|[+-]\d\d:\d\d)$/;

/** ISO 8601 text with an offset, to its parts; null if it is none. Seconds are dropped: the panel has no field for them. */
export function parseTime(text) {
  const match = ISO.exec(text ?? '');
  return match && { date: match[1], time: match[2], offset: match[3] === 'Z' ? '+00:00' : match[3] };
}

export function formatTime({ date, time, offset }) {
  return `${date}T${time}:00${offset}`;
}

/** Noon today by the sun's own clock, to the hour, at a longitude in degrees. */
export function noonToday(longitude) {
  const hours = Math.round(longitude / 15);
  const offset = `${hours < 0 ? '-' : '+'}${String(Math.abs(hours)).padStart(2, '0')}:00`;
  return { date: new Date().toISOString().slice(0, 10), time: '12:00', offset };
}

export function minutesOf(time) {
  const [hours, minutes] = time.split(':').map(Number);
  return hours * 60 + minutes;
}

export function timeOf(minutes) {
  return `${String(Math.floor(minutes / 60)).padStart(2, '0')}:${String(minutes % 60).padStart(2, '0')}`;
}

/** Every offset that a clock on earth keeps, west to east. */
export const OFFSETS = [
  '-12:00', '-11:00', '-10:00', '-09:30', '-09:00', '-08:00', '-07:00', '-06:00', '-05:00', '-04:00', '-03:30', '-03:00',
  '-02:30', '-02:00', '-01:00', '+00:00', '+01:00', '+02:00', '+03:00', '+03:30', '+04:00', '+04:30', '+05:00', '+05:30',
  '+05:45', '+06:00', '+06:30', '+07:00', '+08:00', '+08:45', '+09:00', '+09:30', '+10:00', '+10:30', '+11:00', '+12:00',
  '+12:45', '+13:00', '+13:45', '+14:00',
];
