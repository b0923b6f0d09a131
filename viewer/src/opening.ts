/** Default time of a level whose URL names none: today, in the morning by local time, when shadows are visible. */

import { type Moment, dayOfYear, offsetAt, offsetIn, offsetMinutes } from './moments';
import type { PlacedLevel } from './service';

const DEGREE = Math.PI / 180;
const OBLIQUITY_DEG = 23.44;
const MINUTES_A_DEGREE = 4;
const STEP_MIN = 5;
/** Where the service says nothing: a sun as low as this throws shadows on most ground. */
const LOW_DEG = 20;
/** The sun is put no higher than this share of its height at noon. */
const BELOW_NOON = 0.9;
/** A noon lower than this is the end of a polar night: midsummer is shown. */
const LEAST_NOON_DEG = 6;

/** The sun of a day: degrees north of the equator, and minutes by which its clock is ahead of the mean one. */
function sunOf(date: string): { declination: number; equation: number } {
  // Right to a degree and a minute (Duffie and Beckman, Solar Engineering of Thermal Processes, 1.5 and 1.6).
  const angle = (2 * Math.PI * (dayOfYear(date) - 81)) / 365;
  return { declination: OBLIQUITY_DEG * Math.sin(angle), equation: 9.87 * Math.sin(2 * angle) - 7.53 * Math.cos(angle) - 1.5 * Math.sin(angle) };
}

export function openingMoment({ bounds, sun, time_zone: zone = null }: Pick<PlacedLevel, 'bounds' | 'sun' | 'time_zone'>, now = new Date()): Moment {
  const [west, south, east, north] = bounds;
  const [lon, lat] = [(west + east) / 2, (south + north) / 2];
  const offsetOf = (instant: Date) => (zone && offsetIn(zone, instant)) || offsetAt(lon);
  let offset = offsetOf(now);
  let date = new Date(now.getTime() + offsetMinutes(offset) * 60_000).toISOString().slice(0, 10);
  if (90 - Math.abs(lat - sunOf(date).declination) < LEAST_NOON_DEG) {
    date = `${date.slice(0, 4)}-${lat > 0 ? '06' : '12'}-21`;
    offset = offsetOf(new Date(`${date}T12:00:00Z`));
  }
  const { declination, equation } = sunOf(date);
  const height = Math.min(sun?.altitude ?? LOW_DEG, BELOW_NOON * (90 - Math.abs(lat - declination)));
  const [phi, delta, altitude] = [lat * DEGREE, declination * DEGREE, height * DEGREE];
  const cosine = (Math.sin(altitude) - Math.sin(phi) * Math.sin(delta)) / (Math.cos(phi) * Math.cos(delta));
  // Where the sun is higher all day long, the morning's six o'clock has to do.
  const beforeNoon = cosine > -1 ? Math.acos(Math.min(1, cosine)) / DEGREE : 90;
  const noon = 12 * 60 - MINUTES_A_DEGREE * lon - equation + offsetMinutes(offset);
  const minutes = Math.round((noon - MINUTES_A_DEGREE * beforeNoon) / STEP_MIN) * STEP_MIN;
  return { date, minutes: ((minutes % 1440) + 1440) % 1440, offset };
}

/** The name of a zone's place: New York. */
export function placeOf(zone: string): string {
  return (zone.split('/').pop() ?? zone).replaceAll('_', ' ');
}
