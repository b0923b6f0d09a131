/** A day at a point as a bar of night, shadow and sun from midnight to midnight. */

import { html } from '../dom';
import { DAY_MINUTES } from '../moments';
import type { Span } from './day_spans';
import { clockOf } from './words';

const NAMES = { night: 'night', shadow: 'shadow', lit: 'sun' } as const;

export function dayBar(spans: readonly Span[], minutes: number): HTMLElement {
  const percent = (at: number) => `${(100 * at) / DAY_MINUTES}%`;
  const words = spans.map((span) => `${NAMES[span.light]} ${edge(span.beginsAt)} to ${edge(span.endsAt)}`).join(', ');
  const bar = html('div', { class: 'day-bar', role: 'img', 'aria-label': `The day: ${words}` });
  for (const span of spans) {
    const part = html('span', { class: span.light, title: `${NAMES[span.light]} ${edge(span.beginsAt)}–${edge(span.endsAt)}` });
    part.style.left = percent(span.begin);
    part.style.width = percent(span.end - span.begin);
    bar.append(part);
  }
  const now = html('span', { class: 'now' });
  now.style.left = percent(minutes);
  bar.append(now);
  const hours = html('div', { class: 'day-hours', 'aria-hidden': 'true' });
  for (const hour of [0, 6, 12, 18, 24]) {
    const mark = html('span', {}, String(hour));
    mark.style.left = percent(hour * 60);
    hours.append(mark);
  }
  return html('div', { class: 'day' }, bar, hours);
}

function edge(instant: string | null): string {
  return instant ? clockOf(instant) : 'midnight';
}
