/** Card over the empty map until the service can draw: the task, its progress, and the time so far. */

import { html } from './dom';
import type { Preparation, Readiness } from './readiness';
import type { Note } from './status';
import { ProgressWatch, elapsedText, leftText } from './time_left';
import './start_card.css';

const TICK_MS = 1000;
const FADE_MS = 300;
const UNKNOWN: Preparation = { task: 'waiting for a render process', done: 0, total: 0, elapsed: null };

/** The page's own ridge; the sun goes over it as the work goes on. */
const RIDGE = '<svg viewBox="3.5 0 15 13" width="60" height="52" aria-hidden="true"><circle class="sun" cx="5.7" cy="11.3" r="1.7"/>'
  + '<path d="M4 13 9.5 4 13 9.5l1.5-2L18 13z" class="lit"/><path d="M9.5 4 13 9.5 11.6 13h-1.2z" class="dark"/></svg>';

/** What the card says of a phase. */
export interface StartWords {
  readonly title: string;
  readonly about: string;
  readonly task: string;
}

export function startWords({ phase, preparing }: Readiness): StartWords {
  if (phase === 'unreachable') {
    return { title: 'The service does not answer', about: 'It may be starting anew. This page keeps trying, and goes on by itself.', task: 'Trying again' };
  }
  const task = capital((preparing ?? UNKNOWN).task);
  return preparing?.task.startsWith('compiling')
    ? { title: 'First start', about: 'Compiling, once for this installation. The map then appears by itself.', task }
    : { title: 'The service is starting', about: 'The map appears by itself as soon as it can be drawn.', task };
}

/** 57 of 180; empty while the total is not known. */
export function countText({ preparing }: Readiness): string {
  return preparing?.total ? `${preparing.done} of ${preparing.total}` : '';
}

/** The line over a map that is drawn already; null where there is nothing to say. */
export function noteOf(readiness: Readiness): Note | null {
  const { phase, preparing } = readiness;
  if (phase === 'unreachable') return { words: 'The service does not answer. Trying again …', count: '', quiet: false };
  const count = countText(readiness);
  if (phase === 'starting') return { words: 'The service is starting', count, quiet: false };
  return preparing && { words: capital(preparing.task.replace(/^compiling loops for /, 'preparing ')), count, quiet: true };
}

const capital = (text: string) => text.slice(0, 1).toUpperCase() + text.slice(1);

export class StartCard {
  readonly #title = html('h2', { id: 'start-title' });
  readonly #about = html('p', { class: 'about' });
  readonly #task = html('p', { class: 'task' });
  readonly #bar = html('div', { class: 'bar', role: 'progressbar', 'aria-valuemin': 0 }, html('span'));
  readonly #count = html('span');
  readonly #time = html('span');
  readonly #progress = new ProgressWatch();
  #readiness: Readiness | null = null;
  #since = 0;
  #announced = '';
  #ticks: ReturnType<typeof setInterval> | undefined;
  #hiding: ReturnType<typeof setTimeout> | undefined;

  /** `announce` speaks to screen readers: the card itself changes too often to be read aloud. */
  constructor(private readonly place: HTMLElement, private readonly announce: (words: string) => void) {
    const head = html('header');
    head.innerHTML = RIDGE;
    head.prepend(this.#title);
    place.append(html('section', { class: 'card', 'aria-labelledby': 'start-title' },
      head, this.#about, this.#task, this.#bar, html('p', { class: 'figures' }, this.#count, this.#time)));
  }

  get isShown(): boolean {
    return this.#readiness !== null;
  }

  show(readiness: Readiness): void {
    if (!this.#readiness) {
      this.#since = seconds();
      this.#ticks = setInterval(() => this.#refresh(), TICK_MS);
      clearTimeout(this.#hiding);
    }
    this.#readiness = readiness;
    // Whoever comes late sees how long it has taken so far, not how long they have looked.
    const { elapsed = null } = readiness.preparing ?? {};
    if (elapsed !== null) this.#since = seconds() - elapsed;
    this.#progress.see(readiness.preparing ?? UNKNOWN, seconds());
    this.place.hidden = false;
    this.place.classList.remove('gone');
    this.#refresh();
  }

  hide(): void {
    if (!this.#readiness) return;
    this.#readiness = null;
    clearInterval(this.#ticks);
    this.place.classList.add('gone');
    this.#hiding = setTimeout(() => { this.place.hidden = true; }, FADE_MS);
  }

  #refresh(): void {
    const readiness = this.#readiness;
    if (!readiness) return;
    const now = seconds();
    const { title, about, task } = startWords(readiness);
    const count = countText(readiness);
    const left = count ? this.#progress.secondsLeft(now) : null;
    setText(this.#title, title);
    setText(this.#about, readiness.phase === 'starting' && this.#progress.isStalled(now) ? 'Nothing has moved for a while. The service’s log says more.' : about);
    setText(this.#task, task);
    setText(this.#count, count);
    setText(this.#time, [`${elapsedText(now - this.#since)} so far`, left !== null && leftText(left)].filter(Boolean).join(', '));
    this.#showBar(readiness, task, count);
    if (this.#announced !== title + task) this.announce(`${title}. ${task}. ${about}`);
    this.#announced = title + task;
  }

  #showBar({ preparing }: Readiness, task: string, count: string): void {
    this.#bar.setAttribute('aria-label', task);
    this.#bar.classList.toggle('endless', !count);
    const values = { 'aria-valuemax': preparing?.total, 'aria-valuenow': preparing?.done, 'aria-valuetext': count };
    for (const [name, value] of Object.entries(values)) {
      // Without a value a progress bar is one of unknown length.
      if (count) this.#bar.setAttribute(name, String(value));
      else this.#bar.removeAttribute(name);
    }
    this.place.style.setProperty('--share', preparing?.total ? String(preparing.done / preparing.total) : '0');
  }
}

function setText(element: HTMLElement, text: string): void {
  if (element.textContent !== text) element.textContent = text;
}

const seconds = () => performance.now() / 1000;
