import os, json
import pytest
from tests.browser.test_live import places
from service.pipeline.datasets import actions
from service.pipeline.deletion import delete_dataset

pytestmark = pytest.mark.browser


def test_shots(page, parts, places):
    out = "/tmp/shots"
    os.makedirs(out, exist_ok=True)
    for path in places:
        for width in (390, 1280):
            page.set_viewport_size({"width": width, "height": 900})
            page.goto(path)
            page.wait_for_timeout(150)
            # anything cut inside scroll regions?
            cut = page.evaluate(
                """() => [...document.querySelectorAll('main *')].filter(e => { const r = e.getBoundingClientRect(); const s = getComputedStyle(e); return r.width && s.display !== 'inline' && (s.overflowX === 'hidden' || s.overflowX === 'clip') && e.scrollWidth > e.clientWidth + 1 && !e.matches('.hidden,svg,canvas') }).map(e => e.tagName + '.' + e.className + ' ' + (e.id||'') + ' ' + e.scrollWidth + '>' + e.clientWidth + ': ' + e.innerText.slice(0,60).replace(/\\n/g,' '))"""
            )
            scroll = page.evaluate(
                """() => [...document.querySelectorAll('main *')].filter(e => { const s = getComputedStyle(e); return (s.overflowX === 'auto' || s.overflowX === 'scroll') && e.scrollWidth > e.clientWidth + 1 }).map(e => e.tagName + '.' + e.className + ' ' + e.scrollWidth + '>' + e.clientWidth + ' '+ (e.getAttribute('aria-label')||e.getAttribute('aria-labelledby')||''))"""
            )
            over = page.evaluate(
                """() => [...document.querySelectorAll('main table, main dl, main pre, main form')].filter(e => { const r = e.getBoundingClientRect(); if (!r.width) return false; let p = e.parentElement; while (p && p !== document.body) { const s = getComputedStyle(p); if (s.overflowX==='auto'||s.overflowX==='scroll') return false; p = p.parentElement } return r.right > innerWidth + 1 }).map(e => e.tagName + '.' + e.className + ' ' + (e.id||''))"""
            )
            print(path[:40], width, "CUT", cut, "SCROLL", scroll, "OVER", over)
            page.screenshot(
                path=f"{out}/{path.strip('/').replace('/', '_').replace('?', '_').replace('=', '-')[:40] or 'home'}-{width}.png",
                full_page=True,
            )
    page.set_viewport_size({"width": 1280, "height": 900})
    job = next(p for p in places if p.startswith("/jobs/"))
    page.goto(job)
    page.click("button:has-text('Delete')")
    page.screenshot(path=f"{out}/dialog.png")
    page.set_viewport_size({"width": 390, "height": 800})
    page.screenshot(path=f"{out}/dialog-390.png")
