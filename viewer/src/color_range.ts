/** Range of the colours of hours of sun: the date's, a fixed one for comparing dates, or the user's own. */

import { html } from './dom';
import type { Legend } from './service';
import type { Store } from './state';

const MAX_HOURS = 24;
const OWN = 'own';

/** Lowest and highest hours of a range; null where it follows from the date, or is none. */
export function hoursOf(range: string): readonly [number, number] | null {
  if (range === 'fixed') return [0, MAX_HOURS];
  const [, low, high] = /^(\d{1,2}(?:\.\d{1,2})?),(\d{1,2}(?:\.\d{1,2})?)$/.exec(range) ?? [];
  if (low === undefined || high === undefined) return null;
  return Number(low) < Number(high) && Number(high) <= MAX_HOURS ? [Number(low), Number(high)] : null;
}

/** Whether a text of the address is a range. */
export function isRange(text: string): boolean {
  return text === 'day' || hoursOf(text) !== null;
}

/** The range of two numbers that somebody has typed; null where they are none. */
export function rangeFrom(low: string, high: string): string | null {
  if (low.trim() === '' || high.trim() === '') return null;
  const range = [low, high].map((text) => String(Number(Number(text).toFixed(2)))).join(',');
  return hoursOf(range) && range !== 'NaN,NaN' ? range : null;
}

/** The range that somebody's own begins with: the upper half of the legend's, in which most of a map lies. */
export function firstOwn({ low, high }: Pick<Legend, 'low' | 'high'>, isClock: boolean): string {
  if (isClock) return `${low / 60},${high / 60}`;
  return `${Math.floor(high / 2)},${high}`;
}

export interface RangeFields {
  readonly element: HTMLElement;
  /** Says which range is seen: that of a legend. */
  tell(legend: Legend): void;
  /** Follows the state. */
  refresh(): void;
}

/** Fields of the range, below the quantity. */
export function rangeFields(store: Store): RangeFields {
  let legend: Legend | null = null;
  const isClock = () => ['first', 'last'].includes(store.state.quantity);
  const choice = html('select', { id: 'range', onchange: () => choose(choice.value) },
    html('option', { value: 'day' }, 'of the date'), html('option', { value: 'fixed' }, 'fixed, 0 to 24 hours'), html('option', { value: OWN }, 'my own'));
  const field = (id: string, label: string) => html('input', {
    type: 'number', id, min: 0, max: MAX_HOURS, step: 'any', inputmode: 'decimal', 'aria-label': label, 'aria-describedby': 'range-note', onchange: () => typed(),
  });
  const [low, high] = [field('range-low', 'Hours of the darkest colour'), field('range-high', 'Hours of the brightest colour')];
  const own = html('div', { class: 'row' }, html('span', { 'aria-hidden': 'true' }, 'Hours'), html('span', { class: 'ends' }, low, ' to ', high));
  const note = html('p', { class: 'note', id: 'range-note', role: 'status' });
  const element = html('div', {}, html('label', { class: 'row', for: 'range' }, 'Colours', choice), own, note);

  function choose(value: string): void {
    store.set({ range: value === OWN ? firstOwn(legend ?? { low: 0, high: MAX_HOURS }, isClock()) : value });
    if (value === OWN) low.focus();
  }

  function typed(): void {
    const range = rangeFrom(low.value, high.value);
    note.classList.toggle('fail', range === null);
    for (const input of [low, high]) input.setAttribute('aria-invalid', String(range === null));
    if (range === null) note.textContent = 'Hours from 0 to 24, the first below the second.';
    else store.set({ range });
  }

  return {
    element,
    tell(next) {
      legend = next;
      note.classList.remove('fail');
      const text = (value: number) => (isClock() ? `${Math.floor(value / 60)}:${String(Math.round(value % 60)).padStart(2, '0')}` : String(value));
      note.textContent = `Colours from ${text(next.low)} to ${text(next.high)}${isClock() ? '' : ' hours'}${store.state.range === 'day' ? ', as the sun of the date allows' : ''}.`;
    },
    refresh() {
      const { range } = store.state;
      const hours = hoursOf(range);
      const isOwn = hours !== null && range !== 'fixed';
      choice.value = isOwn ? OWN : range;
      own.hidden = !isOwn;
      if (isOwn) [low.value, high.value] = hours.map(String) as [string, string];
      for (const input of [low, high]) input.removeAttribute('aria-invalid');
    },
  };
}
