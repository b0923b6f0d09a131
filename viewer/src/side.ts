/** The side of the page: the tabs, the open panel, and the sheet that holds them on a phone. */

import { byId, html } from './dom';
import { isFolding, isSheet } from './layout';
import { type PanelContext, panels } from './panels';
import { isPlaced } from './service';

/** Fills the side; returns how to open a panel by its id. */
export function makeSide(makeContext: (open: (id: string) => void) => PanelContext): PanelContext {
  const [side, tabs, place, grip] = [byId('side'), byId('tabs'), byId('panel'), byId<HTMLButtonElement>('sheet')];
  const raise = (up: boolean) => {
    side.classList.toggle('up', up);
    grip.setAttribute('aria-expanded', String(up));
    grip.querySelector('.unseen')?.replaceChildren(up ? 'Close the panel' : 'Open the panel');
  };
  const context = makeContext((id) => {
    context.store.set({ panel: id });
    if (isFolding()) raise(true);
  });
  const { store } = context;
  const there = () => panels().filter(({ needsNoMap }) => needsNoMap || isPlaced(context.level()));
  const open = () => there().find(({ id }) => id === store.state.panel) ?? there()[0];

  const buttons = panels().map(({ id, title }) => html('button', {
    type: 'button', role: 'tab', id: `tab-${id}`, 'aria-controls': 'panel', onclick: () => context.open(id),
  }, title));
  tabs.append(...buttons);
  // As tabs are known elsewhere: arrows go from one to the next, and round.
  tabs.addEventListener('keydown', (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const shown = buttons.filter(({ hidden }) => !hidden);
    const at = shown.findIndex((button) => button === document.activeElement);
    const next = event.key === 'Home' ? 0 : event.key === 'End' ? shown.length - 1 : step === undefined ? null : at + step;
    if (next === null || at < 0) return;
    event.preventDefault();
    const button = shown[(next + shown.length) % shown.length];
    button?.focus();
    button?.click();
  });

  let unmount = () => {};
  store.watch(({ level }) => level, () => {
    const ids = there().map(({ id }) => `tab-${id}`);
    for (const button of buttons) button.hidden = !ids.includes(button.id);
  });
  store.watch(() => open()?.id, (id) => {
    unmount();
    const panel = open();
    for (const button of buttons) {
      const chosen = button.id === `tab-${id}`;
      button.setAttribute('aria-selected', String(chosen));
      button.tabIndex = chosen ? 0 : -1;
    }
    place.setAttribute('aria-labelledby', `tab-${id}`);
    place.replaceChildren();
    const container = html('div', { class: 'panel' });
    place.append(container);
    unmount = panel?.mount(container, context) ?? (() => {});
  });

  grip.addEventListener('click', () => raise(!side.classList.contains('up')));
  dragSheet(side, raise);
  for (const panel of panels()) panel.start?.(context);
  return context;
}

/** Lets the sheet follow a finger on its head: up opens it, down closes it. */
function dragSheet(side: HTMLElement, raise: (up: boolean) => void): void {
  const head = side.querySelector('header');
  let from: number | null = null;
  head?.addEventListener('pointerdown', (event) => {
    if (isSheet() && !(event.target as Element).closest('select')) from = event.clientY;
  });
  window.addEventListener('pointerup', (event) => {
    if (from !== null && Math.abs(event.clientY - from) > 24) raise(event.clientY < from);
    from = null;
  });
}
