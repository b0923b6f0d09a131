/** Base maps: those that the operator offers, and tile URLs that a user pastes. */

import { html } from './dom';
import type { Store } from './state';

export interface BaseMap {
  readonly title: string;
  /** The address of its tiles; without a server it is relative to the service. */
  readonly tiles: string;
  /** HTML of the operator. */
  readonly attribution: string;
  readonly maxzoom: number;
}

/** What a source of the map needs. */
export interface BaseSource {
  readonly tiles: string;
  readonly attribution: string;
  readonly maxzoom: number;
}

const MAX_ZOOM = 22;

export class BaseMaps {
  /** `only`: no others may be pasted. `folder`: the address that relative ones follow. */
  constructor(readonly offered: readonly BaseMap[] = [], readonly only = false, private readonly folder = '') {}

  /** Whether a template of the address may be shown. */
  allows(template: string): boolean {
    return !template || !this.only || this.offered.some(({ tiles }) => tiles === template);
  }

  /** The source of a template: of an offered base map, or of one that was pasted. Null: none, or one that may not be shown. */
  source(template: string): BaseSource | null {
    if (!template || !this.allows(template)) return null;
    const offered = this.offered.find(({ tiles }) => tiles === template);
    if (offered) return { ...offered, tiles: /^https?:/.test(template) ? template : this.folder + template };
    return isTemplate(template) ? { tiles: template.replace('{s}', 'a'), attribution: hostOf(template), maxzoom: MAX_ZOOM } : null;
  }
}

export function isTemplate(text: string): boolean {
  return /^https?:\/\//.test(text) && ['{z}', '{x}', '{y}'].every((part) => text.includes(part));
}

function hostOf(template: string): string {
  try {
    return `Base map: ${new URL(template.replace(/[{}]/g, '')).host}`;
  } catch {
    return 'Base map';
  }
}

/** What a click on a base map changes; empty: none. Shadows alone let the base map be seen; that is what one is chosen for. */
export function withBase(store: Store, template: string): void {
  if (template) store.set({ base: template, ...(store.state.layer === 'color' ? { layer: 'shadow' as const } : {}) });
  else store.set({ base: '', layer: store.state.layer === 'shadow' ? 'color' : store.state.layer, opacity: 1 });
}

/** A choice of the offered base maps; `null` where there are none. */
export function offeredChoice(store: Store, { offered }: BaseMaps): { element: HTMLElement; refresh: () => void } | null {
  if (!offered.length) return null;
  const inputs = [{ title: 'None', tiles: '' }, ...offered].map(({ title, tiles }) => {
    const input = html('input', { type: 'radio', name: 'base-map', value: tiles, onchange: () => withBase(store, tiles) });
    return { input, label: html('label', {}, input, html('span', {}, title)) };
  });
  return {
    element: html('fieldset', { class: 'base-maps' }, html('legend', {}, 'Base map'), html('div', { class: 'choice wrap' }, ...inputs.map(({ label }) => label))),
    refresh: () => { for (const { input } of inputs) input.checked = input.value === store.state.base; },
  };
}
