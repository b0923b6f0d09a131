/** Pictures of views, drawn by the service. */

import { html } from '../dom';
import { sunQuery } from '../query';
import { type Query, type Service, inWords, isAbort } from '../service';
import { settingsQuery } from '../shadow_settings';
import type { State } from '../state';

/** What a snapshot is asked for in a state, besides which view it is of. */
export function snapshotQuery(state: State): Query {
  return { style: state.style, ...sunQuery(state), ...settingsQuery(state) };
}

/** A picture that says while it waits, and what went wrong. */
export class Picture {
  readonly element: HTMLElement;
  readonly #image = html('img', { alt: '', hidden: true });
  readonly #words = html('span', { class: 'waiting' });
  #loading = new AbortController();
  #blob = '';
  #address = '';
  #visible: Promise<boolean | null> = Promise.resolve(false);

  constructor(private readonly service: Service, alt: string, private readonly onShown: () => void = () => {}) {
    this.#image.alt = alt;
    this.element = html('span', { class: 'picture' }, this.#image, this.#words);
  }

  /** What is said in its place; empty where it is seen. */
  get words(): string {
    return this.#words.textContent ?? '';
  }

  /** Says what it is of, for those who do not see it. */
  describe(alt: string): void {
    this.#image.alt = alt;
  }

  /**
   * Shows the picture at an address; the picture before stays until then. Resolves with whether it is visible, or with null
   * where another address was requested meanwhile. Calls with the same address share one request and its result.
   */
  show(address: string): Promise<boolean | null> {
    if (address !== this.#address) {
      this.#address = address;
      this.#visible = this.#load(address);
    }
    return this.#visible;
  }

  async #load(address: string): Promise<boolean | null> {
    this.#loading.abort();
    this.#loading = new AbortController();
    const { signal } = this.#loading;
    this.element.classList.add('busy');
    this.#words.textContent = this.#image.hidden ? 'Drawing …' : '';
    try {
      const blob = await (await this.service.request(address, { signal })).blob();
      if (signal.aborted) return null;
      this.#forget();
      this.#blob = URL.createObjectURL(blob);
      this.#image.src = this.#blob;
      await this.#image.decode();
      this.#image.hidden = false;
      this.#words.textContent = '';
      this.onShown();
    } catch (error) {
      if (isAbort(error) || signal.aborted) return null;
      this.#address = '';
      this.#image.hidden = true;
      this.#words.textContent = inWords(error);
    }
    this.element.classList.remove('busy');
    return !this.#image.hidden;
  }

  /** Gives way to another picture that lies in its element. */
  covered(): void {
    this.#loading.abort();
    this.element.classList.remove('busy');
    this.#image.hidden = true;
    this.#words.textContent = '';
  }

  /** Ends what it does. */
  close(): void {
    this.#loading.abort();
    this.#forget();
  }

  #forget(): void {
    if (this.#blob) URL.revokeObjectURL(this.#blob);
    this.#blob = '';
  }
}
