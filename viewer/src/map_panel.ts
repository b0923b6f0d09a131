/** The panel of the map: layer, base map, opacity and style. */

import { isTemplate, offeredChoice, withBase } from './base_maps';
import { rangeFields } from './color_range';
import { html } from './dom';
import { hasLegend, layersOf } from './layers';
import type { Panel, PanelContext } from './panels';
import { pictureQuery } from './query';
import { type Legend, inWords, isAbort } from './service';
import type { Quantity, State } from './state';

const QUANTITY_WORDS: readonly [Quantity, string][] = [
  ['hours', 'Hours of sun'], ['first', 'First sun'], ['last', 'Last sun'], ['longest', 'Longest spell'],
];

export const mapPanel: Panel = { id: 'map', title: 'Map', mount };

function mount(container: HTMLElement, context: PanelContext): () => void {
  const { store, service, baseMaps } = context;
  const stops: (() => void)[] = [];
  let asking = new AbortController();

  const layers = html('div', { class: 'choice' });
  const about = html('p', { class: 'note' });
  const style = html('select', { id: 'style', onchange: () => store.set({ style: style.value }) });
  const styleRow = html('label', { class: 'row', for: 'style' }, 'Style', style);
  const quantity = html('select', { id: 'quantity', onchange: () => store.set({ quantity: quantity.value as Quantity, range: 'day' }) },
    ...QUANTITY_WORDS.map(([value, words]) => html('option', { value }, words)));
  const legend = html('div', { class: 'legend', 'aria-live': 'polite' });
  const quantityRow = html('label', { class: 'row', for: 'quantity' }, 'Quantity', quantity);
  const range = rangeFields(store);
  const numbers = html('div', {}, quantityRow, range.element, legend);

  const solid = html('input', { type: 'checkbox', id: 'solid', role: 'switch', onchange: () => store.set({ solid: solid.checked }) });
  const base = html('input', {
    type: 'url', id: 'base', placeholder: 'https://…/{z}/{x}/{y}.png', spellcheck: 'false', autocomplete: 'off', 'aria-describedby': 'base-note',
  });
  const baseNote = html('p', { class: 'note', id: 'base-note' });
  const useBase = html('form', {
    class: 'paste',
    // Wrong addresses are told of below, in our words.
    novalidate: true,
    onsubmit: (event) => {
      event.preventDefault();
      const template = base.value.trim();
      const wrong = template && !isTemplate(template);
      baseNote.classList.toggle('fail', Boolean(wrong));
      if (wrong) {
        baseNote.textContent = 'That is no address of XYZ tiles: it has to begin with http and to have {z}, {x} and {y} in it.';
        return;
      }
      withBase(store, template);
    },
  }, html('label', { for: 'base' }, 'Address of XYZ tiles'), html('div', {}, base, html('button', { type: 'submit' }, 'Use')), baseNote);
  const offered = offeredChoice(store, baseMaps);
  const opacity = html('input', {
    type: 'range', id: 'opacity', min: 0.1, max: 1, step: 0.05, oninput: () => store.set({ opacity: Number(opacity.value) }),
  });
  const without = html('button', { type: 'button', class: 'plain', onclick: () => withBase(store, '') }, 'Remove the base map');
  const opacityRow = html('div', {}, html('label', { class: 'row', for: 'opacity' }, 'Strength of the layer', opacity), without);

  container.append(
    html('fieldset', {}, html('legend', { class: 'unseen' }, 'Layer'), layers), about, styleRow, numbers,
    html('label', { class: 'row switch', for: 'solid' }, html('span', {}, 'Three dimensions'), solid),
    offered?.element ?? '',
    baseMaps.only ? '' : html('details', { class: 'base' }, html('summary', {}, offered ? 'Another base map' : 'Base map'), useBase),
    opacityRow,
  );
  if (store.state.base && !baseMaps.offered.some(({ tiles }) => tiles === store.state.base)) container.querySelector('details')?.setAttribute('open', '');

  stops.push(store.watch((state) => [state.level, state.layer], (_, state) => {
    const choices = layersOf(context.level());
    layers.replaceChildren(...choices.map(({ name, label }) => html(
      'label', {}, html('input', { type: 'radio', name: 'layer', value: name, checked: name === state.layer, onchange: () => store.set({ layer: name }) }),
      html('span', {}, label),
    )));
    about.textContent = choices.find(({ name }) => name === state.layer)?.about ?? '';
    numbers.hidden = !hasLegend(context.level(), state.layer);
    quantityRow.hidden = range.element.hidden = state.layer !== 'sunhours';
    const styles = context.level().styles ?? [];
    styleRow.hidden = !styles.length || state.layer !== 'color';
    style.replaceChildren(...styles.map((name) => html('option', { value: name }, name.slice(0, 1).toUpperCase() + name.slice(1))));
  }));
  stops.push(store.watch((state) => [state.level, state.style, state.quantity, state.range, state.solid, state.base, state.opacity], (_, state) => {
    style.value = state.style ?? context.level().style ?? '';
    quantity.value = state.quantity;
    range.refresh();
    solid.checked = state.solid;
    base.value = state.base;
    offered?.refresh();
    opacity.value = String(state.opacity);
    opacityRow.hidden = !state.base;
    if (!baseNote.classList.contains('fail')) baseNote.textContent = 'Its server is then asked for tiles by your browser.';
  }));
  stops.push(store.watch((state) => (hasLegend(context.level(), state.layer) ? [state.level, pictureQuery(state)] : null), (_, state) => void showLegend(state)));

  async function showLegend(state: State): Promise<void> {
    asking.abort();
    if (!hasLegend(context.level(), state.layer)) return;
    asking = new AbortController();
    legend.classList.add('old');
    try {
      const { skugga } = await service.tileJson(state.level, pictureQuery(state), asking.signal);
      if (skugga.legend) {
        legend.replaceChildren(...drawnLegend(skugga.legend));
        range.tell(skugga.legend);
      }
      legend.classList.remove('old');
    } catch (error) {
      if (!isAbort(error)) legend.replaceChildren(html('p', { class: 'note fail' }, inWords(error)));
    }
  }

  return () => {
    asking.abort();
    for (const stop of stops) stop();
  };
}

/** A bar of a legend's colours, with its numbers where they lie. */
function drawnLegend({ title, low, high, entries }: Legend): HTMLElement[] {
  const part = (value: number) => (high > low ? (100 * (value - low)) / (high - low) : 0);
  const colors = entries.map(({ value, color }) => `${color} ${part(value).toFixed(1)}%`).join(', ');
  // More than a handful of numbers would run into each other.
  const every = Math.ceil(entries.length / 7);
  const ticks = entries.filter((_, index) => index % every === 0).map(({ value, label }) => html('span', { style: `left: ${part(value).toFixed(1)}%` }, label));
  return [
    html('p', {}, title), html('div', { class: 'scale', style: `background: linear-gradient(to right, ${colors})` }),
    html('div', { class: 'scale-ticks' }, ...ticks),
  ];
}
