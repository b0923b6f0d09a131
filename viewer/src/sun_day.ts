/** The sun over a day at the middle of the level: sunrise, noon and sunset, as the service computes them. */

import { minutesOfDay } from './moments';
import type { PlacedLevel, Service } from './service';

const DEGREE = Math.PI / 180;
const OBLIQUITY_DEG = 23.44;
const MINUTES_A_DEGREE = 4;

/** What `/levels/NAME/point` says of a day; instants are ISO 8601. */
export interface ReportedDay {
  readonly sunrise: string | null;
  readonly sunset: string | null;
  readonly noon: string;
  readonly noon_altitude: number;
  readonly remark: string | null;
}

export interface SunDay {
  readonly date: string;
  readonly offset: string;
  /** Minutes by the clock of `offset`; null where the sun does not rise or set. */
  readonly sunrise: number | null;
  readonly sunset: number | null;
  readonly noon: number;
  readonly noonAltitude: number;
  readonly lat: number;
  readonly remark: string | null;
}

export interface SunAngles {
  /** Degrees clockwise from north. */
  readonly azimuth: number;
  /** Degrees above the level horizon, refracted. */
  readonly altitude: number;
}

/** The sun's day at the middle of a level; where nothing is there, at the first place of a grid that has ground. Null: nowhere. */
export async function fetchSunDay(service: Service, level: PlacedLevel, date: string, offset: string, signal: AbortSignal): Promise<SunDay | null> {
  const [west, south, east, north] = level.bounds;
  const place = (x: number, y: number) => ({ lon: west + x * (east - west), lat: south + y * (north - south) });
  const ask = async ({ lon, lat }: { lon: number; lat: number }) => {
    const address = service.of(level.name, 'point', { lon: lon.toFixed(5), lat: lat.toFixed(5), date, clock: offset });
    const { day } = await service.json<{ day: ReportedDay | null }>(address, signal);
    return day && told(day, { date, offset, lat });
  };
  const middle = await ask(place(0.5, 0.5));
  if (middle) return middle;
  const grid = Array.from({ length: 49 }, (_, index) => place((0.5 + (index % 7)) / 7, (0.5 + Math.floor(index / 7)) / 7));
  const { points } = await service.json<{ points: { elevation_m: number | null }[] }>(service.of(level.name, 'point'), signal, {
    method: 'POST', headers: { 'Content-Type': 'application/json' }, body: JSON.stringify({ points: grid, date }),
  });
  const found = grid[points.findIndex(({ elevation_m: elevation }) => elevation !== null)];
  return found ? ask(found) : null;
}

/** A day's report by the clock of an offset. */
export function told(day: ReportedDay, { date, offset, lat }: { date: string; offset: string; lat: number }): SunDay {
  const minutes = (instant: string | null) => (instant === null ? null : minutesOfDay(instant, { date, offset }));
  return {
    date, offset, lat,
    sunrise: minutes(day.sunrise), sunset: minutes(day.sunset), noon: minutesOfDay(day.noon, { date, offset }),
    noonAltitude: day.noon_altitude, remark: day.remark,
  };
}

/** Where the sun stands at minutes of the day. */
export function sunAt(day: SunDay, minutes: number): SunAngles {
  const [latitude, declination] = [day.lat * DEGREE, declinationDeg(day) * DEGREE];
  const hourAngle = ((minutes - day.noon) / MINUTES_A_DEGREE) * DEGREE;
  const sine = Math.sin(latitude) * Math.sin(declination) + Math.cos(latitude) * Math.cos(declination) * Math.cos(hourAngle);
  const fromSouth = Math.atan2(
    Math.sin(hourAngle), Math.cos(hourAngle) * Math.sin(latitude) - Math.tan(declination) * Math.cos(latitude),
  );
  return { azimuth: (fromSouth / DEGREE + 540) % 360, altitude: refracted(Math.asin(Math.max(-1, Math.min(1, sine))) / DEGREE) };
}

/** The sun culminates on this side of the zenith or the other; in the tropics the season says on which. */
function declinationDeg({ lat, noonAltitude, date }: SunDay): number {
  const sides = [lat - (90 - noonAltitude), lat + (90 - noonAltitude)];
  const days = (Date.parse(date) - Date.parse(`${date.slice(0, 4)}-01-01`)) / 86_400_000;
  const season = -OBLIQUITY_DEG * Math.cos((Math.PI * 2 * (days + 10)) / 365.25);
  return sides.reduce((best, side) => (Math.abs(side - season) < Math.abs(best - season) ? side : best));
}

/** Saemundsson's formula (Meeus, 16.4), faded out below the horizon. */
function refracted(altitudeDeg: number): number {
  if (altitudeDeg < -1) return altitudeDeg;
  return altitudeDeg + 1.02 / 60 / Math.tan((altitudeDeg + 10.3 / (altitudeDeg + 5.11)) * DEGREE);
}

const WINDS = ['N', 'NNE', 'NE', 'ENE', 'E', 'ESE', 'SE', 'SSE', 'S', 'SSW', 'SW', 'WSW', 'W', 'WNW', 'NW', 'NNW'] as const;

/** The wind of an azimuth: WSW. */
export function windOf(azimuthDeg: number): string {
  return WINDS[Math.round(azimuthDeg / 22.5) % 16] ?? 'N';
}
