/** A day at a point as spans of night, shadow and sun without gaps, from the service's intervals. */

import { DAY_MINUTES, minutesOfDay } from '../moments';
import type { Caster, Day } from './report';

export type Light = 'night' | 'shadow' | 'lit';

/** `begin` and `end` are minutes of the day; the instants are the service's own, null where the day begins or ends. */
export interface Span {
  readonly light: Light;
  readonly begin: number;
  readonly end: number;
  readonly beginsAt: string | null;
  readonly endsAt: string | null;
  /** What hides the sun in a shadow: what it came from behind, or went behind. */
  readonly by: Caster | null;
}

interface Edge {
  readonly at: number;
  readonly instant: string | null;
}

const START: Edge = { at: 0, instant: null };
const END: Edge = { at: DAY_MINUTES, instant: null };

/** The spans in order; `offset` is that of the day's clock (+02:00). */
export function daySpans(day: Day, offset: string): Span[] {
  const edge = (instant: string): Edge => ({ at: minutesOfDay(instant, { date: day.date, offset }), instant });
  const spans: Span[] = [];
  const add = (light: Light, from: Edge, to: Edge, by: Caster | null = null) => {
    if (to.at > from.at) spans.push({ light, begin: from.at, end: to.at, beginsAt: from.instant, endsAt: to.instant, by });
  };
  let night = START;
  for (const [rise, set] of daylight(day, edge)) {
    add('night', night, rise);
    let from = rise;
    let behind: Caster | null = null;
    for (const { begin, end, after, before } of day.sunlit) {
      const [first, last] = [edge(begin), edge(end)];
      if (last.at <= rise.at || first.at >= set.at) continue;
      add('shadow', from, first, after ?? behind);
      // A plain's horizon lets the sun go where it sets: there is no shadow of nothing.
      add('lit', later(from, first), last.at > set.at ? set : last);
      [from, behind] = [last, before];
    }
    add('shadow', from, set, behind);
    night = set;
  }
  add('night', night, END);
  return spans;
}

/** When the sun is above the level horizon: a day by a far clock may begin and end with it. */
function daylight({ sunrise, sunset, daylight_h }: Day, edge: (instant: string) => Edge): [Edge, Edge][] {
  const rise = sunrise === null ? null : edge(sunrise);
  const set = sunset === null ? null : edge(sunset);
  if (rise && set) return rise.at < set.at ? [[rise, set]] : [[START, set], [rise, END]];
  if (rise) return [[rise, END]];
  if (set) return [[START, set]];
  return daylight_h > 0 ? [[START, END]] : [];
}

function later(one: Edge, other: Edge): Edge {
  return other.at >= one.at ? other : one;
}

/** The span of a minute of the day. */
export function spanAt(spans: readonly Span[], minutes: number): Span | undefined {
  return spans.find(({ begin, end }) => begin <= minutes && minutes < end) ?? spans.at(-1);
}
