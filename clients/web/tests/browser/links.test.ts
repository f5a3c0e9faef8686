/** Links to the viewer, which are valid once. */

import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import { networkInterfaces } from "node:os";
import { after, before, test } from "node:test";
import type { Browser, Page } from "playwright-core";
import {
    end,
    launchBrowser,
    openPage,
    printedUrl,
    programPath,
    ServerProcess,
    startProgram,
    takeScreenshot,
    temporaryFolder,
    waitForScene,
} from "./harness";

const LIMIT_MS = 120_000;
const server = new ServerProcess("", [], true);
let browser: Browser;

before(async () => {
    await server.start();
    browser = await launchBrowser();
});
after(async () => {
    await browser?.close();
    await server.stop();
});

/** A link of the user of the server. */
function newLink(): string {
    return execFileSync(programPath("modalcast"), ["link", "--server", server.grpcUrl]).toString().trim();
}

async function openTree(page: Page): Promise<void> {
    await page.getByRole("heading", { name: "No scene is open" }).waitFor();
    await page.getByRole("button", { name: "tree" }).click();
    await waitForScene(page);
}

function waitForRequestOfLink(page: Page): Promise<void> {
    return page.getByRole("heading", { name: "This page needs a new link" }).waitFor();
}

test("a link gives a session that outlasts loading the page again", { timeout: LIMIT_MS }, async () => {
    const { page, errors } = await openPage(browser, server.link, 900, 600);
    await openTree(page);
    assert.ok(!page.url().includes("code"), page.url());
    await page.reload();
    await waitForScene(page);
    assert.deepEqual(errors, []);
    await page.close();
});

test("a used link tells how to get another, which opens in the same tab", { timeout: LIMIT_MS }, async () => {
    const link = newLink();
    const first = await openPage(browser, `${link}&scene=tree`, 900, 600);
    await waitForScene(first.page);
    await first.page.close();
    const { page } = await openPage(browser, `${link}&scene=tree`, 900, 600);
    await waitForRequestOfLink(page);
    await page.getByText("The link was used before or has expired").waitFor();
    await page.getByText("modalcast link").waitFor();
    await takeScreenshot(page, "used-link");
    // A new link differs only in its fragment, so that the browser does not load the page again.
    await page.goto(`${newLink()}&scene=tree`);
    await waitForScene(page);
    await page.close();
});

test("a page without a link needs one, also after a restart of the server", { timeout: LIMIT_MS }, async () => {
    const without = await openPage(browser, server.pageUrl("tree"), 900, 600);
    await waitForRequestOfLink(without.page);
    await without.page.close();
    const { page } = await openPage(browser, `${newLink()}&scene=tree`, 900, 600);
    await waitForScene(page);
    await server.stop();
    await server.start();
    await page.getByText("This page needs a new link").first().waitFor();
    await page.goto(`${newLink()}&scene=tree`);
    await page.getByText("This page needs a new link").first().waitFor({ state: "hidden" });
    await page.close();
});

/** The address of this machine on its network or, without one, its loopback address. */
function networkAddress(): string {
    const addresses = Object.values(networkInterfaces()).flatMap((list) => list ?? []);
    return addresses.find(({ family, internal }) => family === "IPv4" && !internal)?.address ?? "127.0.0.1";
}

test("a phone opens the printed link of a server with TLS", { timeout: LIMIT_MS }, async () => {
    const options = ["--listen", "0.0.0.0:0", "--tls-self-signed", "--backend", "cpu", "--state", temporaryFolder()];
    const encrypted = startProgram("modalcast", ["serve", ...options], ["ignore", "pipe", "pipe"]);
    const link = new URL(await printedUrl(encrypted, "viewer from another machine at"));
    assert.equal(link.protocol, "https:");
    // The name of this machine needs not be known here.
    link.hostname = networkAddress();
    const phone = { isMobile: true, hasTouch: true, deviceScaleFactor: 2 };
    // Users accept a self-signed certificate in their browser.
    const { page, errors } = await openPage(browser, link.href, 390, 844, { ...phone, ignoreHTTPSErrors: true });
    await openTree(page);
    await takeScreenshot(page, "phone-tls");
    assert.deepEqual(errors, []);
    await page.close();
    // Control: the browser does not trust the certificate by itself.
    await assert.rejects(openPage(browser, link.href), /ERR_CERT_AUTHORITY_INVALID/);
    await end(encrypted);
});
