/** The day of a view: a slider below its picture that plays it from sunrise to sunset, and a button that makes a film. */

import { html } from '../dom';
import { clockText } from '../moments';
import { stepsOf } from '../player';
import { saveFile } from '../saved';
import { type PlacedLevel, type Service, inWords, isAbort } from '../service';
import type { State } from '../state';
import { fetchSunDay } from '../sun_day';
import { DEFAULT_FILM_STEP_MIN, FILM_STEPS_MIN, type FilmView, filmBody, filmTimes, makeFilm } from './film';

const STEP_MS = 100;
const CALM_STEP_MS = 1000;
const CALM_MS = 250;
/** So many pictures ahead are wanted, of which so many are asked for at a time. */
const AHEAD = 12;
const AT_ONCE = 2;

export interface DayOfView {
  readonly level: PlacedLevel;
  readonly state: State;
  /** Width and height of the view's own picture. */
  readonly size: readonly [number, number];
  readonly film: FilmView;
  /** The address of the view's picture in a state; `size` null: its own. */
  address(state: State, suffix: 'png' | 'webp', size: string | null): string;
}

/** Pictures of a view at times of the day, loaded once each. */
class DayPictures {
  readonly #loads = new Map<number, Promise<HTMLImageElement>>();
  readonly #urls = new Set<string>();
  readonly #loaded = new Set<number>();

  constructor(private readonly service: Service, private readonly address: (minutes: number) => string, private readonly signal: AbortSignal) {}

  get loadedCount(): number {
    return this.#loaded.size;
  }

  load(minutes: number): Promise<HTMLImageElement> {
    const known = this.#loads.get(minutes);
    if (known) return known;
    const load = this.#fetch(minutes);
    this.#loads.set(minutes, load);
    // What failed is asked for again.
    load.catch(() => this.#loads.delete(minutes));
    return load;
  }

  close(): void {
    for (const url of this.#urls) URL.revokeObjectURL(url);
  }

  async #fetch(minutes: number): Promise<HTMLImageElement> {
    const blob = await (await this.service.request(this.address(minutes), { signal: this.signal })).blob();
    if (this.signal.aborted) throw new DOMException('aborted', 'AbortError');
    const image = new Image();
    image.src = URL.createObjectURL(blob);
    this.#urls.add(image.src);
    await image.decode();
    this.#loaded.add(minutes);
    return image;
  }
}

export class ViewDay {
  readonly element: HTMLElement;
  /** The picture of the time that is played. */
  readonly #frame = html('img', { class: 'day-frame', alt: '' });
  readonly #play: HTMLButtonElement;
  readonly #slider: HTMLInputElement;
  readonly #clock = html('output', { for: 'view-minutes' });
  readonly #film: HTMLButtonElement;
  readonly #filmStep: HTMLSelectElement;
  readonly #progress = html('span', { class: 'note' });
  readonly #said = html('p', { class: 'note', role: 'status' });
  readonly #closing = new AbortController();
  #playing: AbortController | null = null;
  #filming: AbortController | null = null;
  #steps: Promise<number[]> | null = null;
  #pictures: DayPictures | null = null;
  #minutes: number | null = null;
  #timer: ReturnType<typeof setTimeout> | undefined;

  /** `width`: CSS pixels that the picture has on the page; `shown` puts the day's picture in its place. */
  constructor(
    private readonly service: Service, private readonly day: DayOfView, private readonly title: string, private readonly name: string,
    private readonly width: () => number, private readonly shown: (frame: HTMLImageElement) => void,
  ) {
    this.#play = html('button', { type: 'button', class: 'main', 'aria-pressed': 'false', onclick: () => void this.#toggle() }, 'Play the day');
    this.#slider = html('input', {
      type: 'range', id: 'view-minutes', min: 0, max: 1430, step: 10, 'aria-label': 'Time of the view', oninput: () => this.#choose(Number(this.#slider.value)),
    });
    this.#film = html('button', { type: 'button', onclick: () => void this.#toggleFilm() }, 'Make a film');
    this.#filmStep = html('select', { 'aria-label': 'Time between the pictures of the film' }, ...FILM_STEPS_MIN.map((minutes) => (
      html('option', { value: minutes, selected: minutes === DEFAULT_FILM_STEP_MIN }, `every ${minutes} minutes`))));
    this.element = html('div', { class: 'view-day' }, this.#play, this.#slider, this.#clock, this.#film, this.#filmStep, this.#progress, this.#said);
    this.#tellTime(day.state.minutes);
  }

  /** The state of the picture that is seen: that of the page, or another time of its date. */
  get state(): State {
    return this.#minutes === null ? this.day.state : this.#at(this.#minutes);
  }

  close(): void {
    clearTimeout(this.#timer);
    this.#closing.abort();
    this.#playing?.abort();
    this.#filming?.abort();
    this.#pictures?.close();
  }

  #at(minutes: number): State {
    return { ...this.day.state, minutes, sunBy: 'time' };
  }

  /** The times of the day's pictures; asked for once. */
  #times(): Promise<number[]> {
    const { level, state } = this.day;
    this.#steps ??= fetchSunDay(this.service, level, state.date, state.offset, this.#closing.signal).then((day) => {
      if (!day) throw new Error('The service knows no sunrise of this place.');
      const steps = stepsOf(day);
      Object.assign(this.#slider, { min: String(steps[0]), max: String(steps.at(-1)) });
      return steps;
    });
    this.#steps.catch(() => { this.#steps = null; });
    return this.#steps;
  }

  #load(minutes: number): Promise<HTMLImageElement> {
    const [width, height] = this.day.size;
    const scale = Math.min(1, (this.width() * window.devicePixelRatio) / width);
    const size = `${Math.max(Math.round(width * scale), 1)}x${Math.max(Math.round(height * scale), 1)}`;
    this.#pictures ??= new DayPictures(this.service, (at) => this.day.address(this.#at(at), 'webp', size), this.#closing.signal);
    return this.#pictures.load(minutes);
  }

  #show(minutes: number, image: HTMLImageElement): void {
    this.#minutes = minutes;
    this.#frame.src = image.src;
    this.#frame.alt = `${this.title} at ${clockText(minutes)}`;
    if (!this.#frame.isConnected) this.shown(this.#frame);
    this.#tellTime(minutes);
  }

  #tellTime(minutes: number): void {
    this.#slider.value = String(minutes);
    this.#slider.setAttribute('aria-valuetext', clockText(minutes));
    this.#clock.value = clockText(minutes);
  }

  #say(words: string, isFault = false): void {
    this.#said.classList.toggle('fail', isFault);
    this.#said.textContent = words;
  }

  // --- playing ----------------------------------------------------------------------------------------------------------

  /** Shows a time that somebody chose; playing ends. */
  #choose(minutes: number): void {
    this.#playing?.abort();
    this.#tellTime(minutes);
    clearTimeout(this.#timer);
    this.#timer = setTimeout(async () => {
      try {
        this.#progress.textContent = `Drawing ${clockText(minutes)} …`;
        const image = await this.#load(minutes);
        if (Number(this.#slider.value) === minutes && !this.#playing) this.#show(minutes, image);
        this.#say('');
      } catch (error) {
        if (!isAbort(error)) this.#say(inWords(error), true);
      } finally {
        if (!this.#playing) this.#progress.textContent = '';
      }
    }, CALM_MS);
  }

  async #toggle(): Promise<void> {
    if (this.#playing) {
      this.#playing.abort();
      return;
    }
    clearTimeout(this.#timer);
    const ending = new AbortController();
    this.#playing = ending;
    this.#play.textContent = 'Pause the day';
    this.#play.setAttribute('aria-pressed', 'true');
    this.#say('');
    try {
      await this.#run(ending.signal);
    } catch (error) {
      if (!isAbort(error)) this.#say(inWords(error), true);
    } finally {
      if (this.#playing === ending) this.#playing = null;
      this.#play.textContent = 'Play the day';
      this.#play.setAttribute('aria-pressed', 'false');
      this.#progress.textContent = '';
      if (this.#minutes !== null) this.#tellTime(this.#minutes);
    }
  }

  /** Plays round and round, from the present time on if the sun is up then. */
  async #run(signal: AbortSignal): Promise<void> {
    const takes = matchMedia('(prefers-reduced-motion: reduce)').matches ? CALM_STEP_MS : STEP_MS;
    this.#progress.textContent = 'Asking for sunrise and sunset …';
    const steps = await until(signal, this.#times());
    const from = this.#minutes ?? this.day.state.minutes;
    let at = Math.max(0, steps.findIndex((minutes) => minutes >= from));
    for (let due = performance.now(); !signal.aborted; at = (at + 1) % steps.length) {
      const minutes = steps[at] ?? 0;
      const load = this.#load(minutes);
      this.#fetchAhead(steps, at);
      const missing = setTimeout(() => { this.#progress.textContent = `Drawing ${clockText(minutes)}: ${this.#pictures?.loadedCount ?? 0} of ${steps.length} pictures`; }, takes);
      const image = await until(signal, load).finally(() => clearTimeout(missing));
      if (this.#pictures?.loadedCount === steps.length) this.#progress.textContent = '';
      await until(signal, pause(due - performance.now()));
      while (document.hidden && !signal.aborted) await until(signal, pause(takes));
      if (signal.aborted) return;
      this.#show(minutes, image);
      due = performance.now() + takes;
    }
  }

  #fetching = false;

  /** Loads the next pictures, so many at a time. Failures are told by the step that needs the picture. */
  #fetchAhead(steps: readonly number[], at: number): void {
    if (this.#fetching) return;
    this.#fetching = true;
    const wanted = Array.from({ length: Math.min(AHEAD, steps.length - 1) }, (_, ahead) => steps[(at + 1 + ahead) % steps.length] ?? 0);
    const lane = async () => {
      for (let minutes = wanted.shift(); minutes !== undefined && this.#playing; minutes = wanted.shift()) await this.#load(minutes);
    };
    void Promise.allSettled(Array.from({ length: AT_ONCE }, lane)).then(() => { this.#fetching = false; });
  }

  // --- the film ---------------------------------------------------------------------------------------------------------

  async #toggleFilm(): Promise<void> {
    if (this.#filming) {
      this.#filming.abort();
      return;
    }
    const ending = new AbortController();
    this.#filming = ending;
    this.#film.textContent = 'Stop the film';
    this.#say('The film is being asked for …');
    try {
      const { state, film, size, level } = this.day;
      const stepMinutes = Number(this.#filmStep.value);
      const body = filmBody(state, film, size, filmTimes(await until(ending.signal, this.#times()), stepMinutes));
      const tell = (done: number, all: number) => { this.#say(`The service is drawing the film: ${done} of ${all} pictures.`); };
      const address = await makeFilm(this.service, level.name, body, tell, ending.signal);
      await saveFile(this.service, address, `${this.name}-${state.date}.webp`, ending.signal);
      this.#say('The film is saved.');
    } catch (error) {
      if (isAbort(error)) this.#say('The film was stopped.');
      else this.#say(`No film: ${inWords(error)}`, true);
    } finally {
      this.#filming = null;
      this.#film.textContent = 'Make a film';
    }
  }
}

/** A promise, or an abort that comes before it. */
function until<Value>(signal: AbortSignal, promise: Promise<Value>): Promise<Value> {
  return new Promise((resolve, reject) => {
    const abort = () => reject(new DOMException('aborted', 'AbortError'));
    if (signal.aborted) abort();
    signal.addEventListener('abort', abort, { once: true });
    promise.then(resolve, reject).finally(() => signal.removeEventListener('abort', abort));
  });
}

const pause = (milliseconds: number) => new Promise<void>((resolve) => { setTimeout(resolve, Math.max(0, milliseconds)); });
