/** Controls of the sun: date and time with the day's path, or a direction, and the button that plays the day. */

import { HeightDial, SkyDial } from './dial';
import { html } from './dom';
import { OFFSETS, clockText, dateOfYear, dateText, dayOfYear, daysInYear, offsetIn, onDate } from './moments';
import { placeOf } from './opening';
import type { State, Store } from './state';
import { type SunAngles, type SunDay, windOf } from './sun_day';

const MONTHS = ['J', 'F', 'M', 'A', 'M', 'J', 'J', 'A', 'S', 'O', 'N', 'D'] as const;

const CLOCK = /^([01]?\d|2[0-3])[:.]([0-5]\d)$/;

export interface Dock {
  /** Draws a day's path; null: it is on its way, or not known. */
  showDay(day: SunDay | null): void;
  /** Says where the sun stands, as the service has it; null: not known. */
  showSun(sun: SunAngles | null): void;
  showPlaying(plays: boolean): void;
  /** Whether the day can be played: before the service draws, it cannot. */
  allowPlaying(allowed: boolean): void;
  /** Whether there is a date and a time: without a place on the earth there is none. The time zone of the place, if it is known. */
  setPlace(hasPlace: boolean, zone: string | null): void;
  /** How far pictures of the day are there; null: nothing is waited for. */
  showWaiting(share: number | null): void;
}

export function makeDock(container: HTMLElement, store: Store, onPlay: () => void): Dock {
  const height = new HeightDial();
  const sky = new SkyDial();
  let day: SunDay | null = null;
  let canPlay: boolean | null = null;
  let hasPlace = true;
  let zone: string | null = null;

  // --- the parts ----------------------------------------------------------------------------------------------------

  const play = html('button', { type: 'button', id: 'play', 'aria-label': 'Play the day', 'aria-pressed': 'false', onclick: onPlay });
  play.innerHTML = '<svg viewBox="0 0 20 20" aria-hidden="true"><path class="go" d="M6 3.5v13l11-6.5z"/><path class="halt" d="M5 4h3.6v12H5zM11.4 4H15v12h-3.6z"/></svg>';
  const clock = html('input', { id: 'clock', 'aria-label': 'Time', inputmode: 'numeric', maxlength: 5, size: 5, autocomplete: 'off', spellcheck: 'false' });
  const date = html('input', { type: 'date', id: 'date', 'aria-label': 'Date', required: true });
  const words = html('p', { id: 'sun-words' });

  const minutes = html('input', { type: 'range', id: 'minutes', min: 0, max: 1435, step: 5, 'aria-label': 'Time of day' });
  const marks = html('div', { class: 'marks' });
  const byHour = html('div', { class: 'hours', 'aria-hidden': 'true' }, ...[0, 6, 12, 18, 24].map((hour) => html('span', {}, String(hour))));
  const path = html('div', { class: 'path-place' }, height.element, html('div', { class: 'dot-place' }, height.dot), minutes);

  const days = html('input', { type: 'range', id: 'days', min: 1, max: 365, 'aria-label': 'Day of the year' });
  const months = html('div', { class: 'months', 'aria-hidden': 'true' }, ...MONTHS.map((letter) => html('span', {}, letter)));
  const year = html('div', { class: 'year' }, days, months);

  const offset = html('select', { id: 'offset', 'aria-label': 'Clock' }, ...OFFSETS.map(offsetOption));
  const direction = html('button', { type: 'button', id: 'by', class: 'plain' });

  const azimuth = html('input', { type: 'range', id: 'azimuth', min: 0, max: 359, step: 1 });
  const altitude = html('input', { type: 'range', id: 'altitude', min: -5, max: 90, step: 0.5 });
  const azimuthSaid = html('output', { for: 'azimuth' });
  const altitudeSaid = html('output', { for: 'altitude' });

  const byTime = html('div', { class: 'by-time' }, path, byHour, marks, year);
  const lamps = html('p', { class: 'note lamps' }, 'This level is lit by lamps of its own, without a sun.');
  const byAngles = html(
    'div', { class: 'by-angles' },
    html('label', { for: 'azimuth' }, html('span', {}, 'Azimuth, clockwise from north'), azimuthSaid, azimuth),
    html('label', { for: 'altitude' }, html('span', {}, 'Height above the horizon'), altitudeSaid, altitude),
  );
  container.append(
    html(
      'div', { class: 'now' }, play, html('div', { class: 'moment' }, clock, date), sky.element, words,
      html('div', { class: 'more' }, offset, direction),
    ),
    byTime, byAngles, lamps,
  );

  // --- what a person does -------------------------------------------------------------------------------------------

  minutes.addEventListener('input', () => store.set({ minutes: Number(minutes.value) }));
  // A field of text: browsers show fields of time by their own language, in 12 hours here and in 24 there.
  clock.addEventListener('input', () => {
    const [, hours, rest] = CLOCK.exec(clock.value) ?? [];
    if (hours && rest) store.set({ minutes: Number(hours) * 60 + Number(rest) });
  });
  clock.addEventListener('blur', () => refresh(store.state));
  const setDate = (next: string) => {
    const { date: before, minutes: at, offset: clockOffset } = store.state;
    store.set(onDate({ date: before, minutes: at, offset: clockOffset }, next, zone));
  };
  date.addEventListener('input', () => { if (date.value) setDate(date.value); });
  days.addEventListener('input', () => setDate(dateOfYear(Number(store.state.date.slice(0, 4)), Number(days.value))));
  offset.addEventListener('change', () => store.set({ offset: offset.value }));
  direction.addEventListener('click', () => store.set({ sunBy: store.state.sunBy === 'time' ? 'angles' : 'time' }));
  azimuth.addEventListener('input', () => store.set({ azimuth: Number(azimuth.value) }));
  altitude.addEventListener('input', () => store.set({ altitude: Number(altitude.value) }));

  // --- what follows from the state ----------------------------------------------------------------------------------

  store.watch(
    (state) => [state.date, state.minutes, state.offset, state.sunBy, state.azimuth, state.altitude, state.layer],
    (_, state) => refresh(state),
  );

  function refresh(state: State): void {
    const byMoment = state.sunBy === 'time' || state.layer === 'sunhours';
    container.dataset.by = byMoment ? 'time' : state.sunBy;
    container.classList.toggle('flat', !hasPlace);
    container.classList.toggle('whole-day', state.layer === 'sunhours');
    byTime.hidden = !byMoment;
    byAngles.hidden = byMoment || state.sunBy === 'none';
    lamps.hidden = state.sunBy !== 'none';
    minutes.disabled = clock.disabled = state.layer === 'sunhours';
    play.disabled = !canPlay || state.layer === 'sunhours';
    direction.hidden = state.layer === 'sunhours' || !hasPlace;
    direction.textContent = byMoment ? 'By direction' : 'By date and time';
    if (document.activeElement !== clock) clock.value = clockText(state.minutes);
    if (date.value !== state.date) date.value = state.date;
    minutes.value = String(state.minutes);
    minutes.setAttribute('aria-valuetext', clockText(state.minutes));
    days.max = String(daysInYear(Number(state.date.slice(0, 4))));
    days.value = String(dayOfYear(state.date));
    days.setAttribute('aria-valuetext', dateText(state.date));
    if (!OFFSETS.includes(state.offset) && !offset.querySelector(`[value="${CSS.escape(state.offset)}"]`)) offset.append(offsetOption(state.offset));
    offset.value = state.offset;
    const own = zone && offsetIn(zone, new Date(`${state.date}T${clockText(state.minutes)}:00${state.offset}`));
    for (const option of offset.options) option.text = option.value === own && zone ? `${offsetText(own)} · ${placeOf(zone)}` : offsetText(option.value);
    azimuth.value = String(state.azimuth);
    altitude.value = String(state.altitude);
    azimuthSaid.value = `${state.azimuth}° · ${windOf(state.azimuth)}`;
    altitudeSaid.value = `${state.altitude}°`;
    azimuth.setAttribute('aria-valuetext', azimuthSaid.value);
    altitude.setAttribute('aria-valuetext', altitudeSaid.value);
    height.move(state.minutes);
  }

  height.show(null);
  sky.move(null);

  function mark(name: string, at: number | null): HTMLElement | null {
    if (at === null) return null;
    const whole = Math.min(1435, Math.max(0, Math.round(at)));
    return html(
      'button', { type: 'button', class: 'plain', onclick: () => store.set({ minutes: whole }) },
      html('span', {}, name), ' ', html('b', {}, clockText(whole)),
    );
  }

  return {
    showDay(next) {
      day = next;
      height.show(day);
      height.move(store.state.minutes);
      sky.show(day);
      const parts = day ? [mark('Sunrise', day.sunrise), mark('Noon', day.noon), mark('Sunset', day.sunset)] : [];
      const remark = day?.remark && (day.sunrise === null || day.sunset === null) ? html('span', { class: 'note' }, sentence(day.remark)) : null;
      marks.replaceChildren(...[...parts, remark].filter((part) => part !== null));
    },
    showSun(sun) {
      sky.move(sun);
      words.replaceChildren(...(sun ? told(sun) : ['']));
    },
    showPlaying(plays) {
      play.setAttribute('aria-pressed', String(plays));
      play.setAttribute('aria-label', plays ? 'Pause the day' : 'Play the day');
      container.classList.toggle('playing', plays);
    },
    allowPlaying(allowed) {
      if (allowed === canPlay) return;
      canPlay = allowed;
      refresh(store.state);
      if (!day) marks.replaceChildren(allowed ? '' : html('span', { class: 'note' }, 'Sunrise and sunset come with the map.'));
    },
    setPlace(placed, itsZone) {
      [hasPlace, zone] = [placed, itsZone];
      refresh(store.state);
    },
    showWaiting(share) {
      container.classList.toggle('fetching', share !== null);
      play.style.setProperty('--share', String(share ?? 1));
    },
  };
}

function told({ azimuth, altitude }: SunAngles): HTMLElement[] {
  if (altitude < 0) return [html('b', {}, 'The sun is down'), html('span', {}, `${altitude.toFixed(1)}° below the horizon`.replace('-', ''))];
  return [html('b', {}, `Sun ${altitude.toFixed(1)}° high`), html('span', {}, `${azimuth.toFixed(1)}° · ${windOf(azimuth)}`)];
}

function offsetOption(offset: string): HTMLOptionElement {
  return html('option', { value: offset }, offsetText(offset));
}

function offsetText(offset: string): string {
  const said = offset.replace('-', '−').replace(/^([+−])0/, '$1').replace(/:00$/, '');
  return said === '+0' ? 'UTC' : `UTC${said}`;
}

const sentence = (text: string) => `${text.slice(0, 1).toUpperCase()}${text.slice(1)}.`;
